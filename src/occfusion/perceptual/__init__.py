"""Perceptual distances with published weights."""

from occfusion.perceptual.crop import random_crop_box
from occfusion.perceptual.metric import Features, PerceptualMetric, load_perceptual

__all__ = ["Features", "PerceptualMetric", "load_perceptual", "random_crop_box"]
