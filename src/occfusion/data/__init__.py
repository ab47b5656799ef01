"""Data folders to frames: readers, simulated occlusion, and the LightningDataModules over them."""

from occfusion.data.module import HumanDataModule
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.ocmotion.ocmotion_data import OcMotionDataModule
from occfusion.data.video.video_data import VideoDataModule
from occfusion.data.zju.zju_data import ZjuDataModule

__all__ = ["HumanDataModule", "OcMotionDataModule", "OcclusionSettings", "VideoDataModule", "ZjuDataModule"]
