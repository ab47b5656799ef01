"""Data folders to frames: readers, simulated occlusion, and the LightningDataModules over them."""

from occfusion.data.module import HumanDataModule
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.zju import ZjuDataModule

__all__ = ["HumanDataModule", "OcclusionSettings", "ZjuDataModule"]
