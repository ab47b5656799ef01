"""Data folders to frames: readers, simulated occlusion, and the LightningDataModules over them."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from occfusion.data.module import HumanDataModule
    from occfusion.data.occlusion import OcclusionSettings
    from occfusion.data.ocmotion.ocmotion_data import OcMotionDataModule
    from occfusion.data.video.video_data import VideoDataModule
    from occfusion.data.zju.zju_data import ZjuDataModule

__all__ = ["HumanDataModule", "OcMotionDataModule", "OcclusionSettings", "VideoDataModule", "ZjuDataModule"]

_HOME = {
    "HumanDataModule": "module",
    "OcMotionDataModule": "ocmotion.ocmotion_data",
    "OcclusionSettings": "occlusion",
    "VideoDataModule": "video.video_data",
    "ZjuDataModule": "zju.zju_data",
}


def __getattr__(name: str) -> Any:
    """Imports a class when it is asked for: to read one file needs no Lightning, which takes seconds to import."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
