"""Perceptual distances with published weights."""

from occfusion.perceptual.metric import Features, PerceptualMetric, load_perceptual, random_crop_box

__all__ = ["Features", "PerceptualMetric", "load_perceptual", "random_crop_box"]
