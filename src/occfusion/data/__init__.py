"""Data folders to frames: readers, simulated occlusion, and the LightningDataModules over them."""

from occfusion.data.module import HumanDataModule
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.ocmotion import OcMotionDataModule
from occfusion.data.video import VideoDataModule
from occfusion.data.zju import ZjuDataModule

__all__ = ["HumanDataModule", "OcMotionDataModule", "OcclusionSettings", "VideoDataModule", "ZjuDataModule"]
