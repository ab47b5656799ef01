"""Perceptual distances with published weights."""

from occfusion.perceptual.crop import random_crop_box
from occfusion.perceptual.metric import Features, PerceptualMetric, load_perceptual
from occfusion.perceptual.precision import PRECISIONS, training_dtype

__all__ = [
    "PRECISIONS",
    "Features",
    "PerceptualMetric",
    "load_perceptual",
    "random_crop_box",
    "training_dtype",
]
