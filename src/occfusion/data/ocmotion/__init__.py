"""OcMotion: as released with CHOMP, and as Wild2Avatar cut it."""

from occfusion.data.ocmotion.ocmotion_data import OcMotionDataModule

__all__ = ["OcMotionDataModule"]
