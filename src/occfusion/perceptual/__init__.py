"""Perceptual distances with published weights."""

from occfusion.perceptual.crop import random_crop_box
from occfusion.perceptual.metric import (
    PRECISIONS,
    Features,
    PerceptualMetric,
    load_perceptual,
    training_dtype,
)

__all__ = [
    "PRECISIONS",
    "Features",
    "PerceptualMetric",
    "load_perceptual",
    "random_crop_box",
    "training_dtype",
]
