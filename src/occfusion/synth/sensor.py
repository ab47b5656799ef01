"""From light to a file: a soft lens, automatic exposure, noise of the sensor, the sRGB curve."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.synth.rotations import Floats

Picture = NDArray[np.float32]

SOFTNESS = 0.55  # pixels: standard deviation of the lens, whatever their number
SHOT_NOISE = 1.5e-4  # variance at full light, of full light squared: 6 700 electrons, a small sensor
READ_NOISE = 1.5e-3  # standard deviation in the dark, of full light
WHITE = 0.80  # of full light: where the brightest hundredth of the person lies at the first moment
REACTION = 0.5  # of a change of the metered light, in its logarithm, that the exposure takes back
CENTRE = 0.35  # of the picture's width: standard deviation of the weights of the metering
JPEG_QUALITY = 82
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


def to_linear(encoded: NDArray[np.floating]) -> Picture:
    """Returns linear light of sRGB values, both 0..1 (IEC 61966-2-1)."""
    v = np.asarray(encoded, np.float32)
    return np.where(v <= 0.04045, v / 12.92, ((np.maximum(v, 0.04045) + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )


def to_srgb(linear: NDArray[np.floating]) -> Picture:
    """Returns sRGB values of linear light, both 0..1; what is brighter is clipped (IEC 61966-2-1)."""
    v = np.clip(np.asarray(linear, np.float32), 0.0, 1.0)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 0.0031308) ** (1 / 2.4) - 0.055).astype(
        np.float32
    )


def metered(picture: Picture) -> float:
    """Returns the luminance of a linear picture, its middle counting most."""
    height, width = picture.shape[:2]
    rows = (np.arange(height) + 0.5) / height - 0.5
    columns = (np.arange(width) + 0.5) / width - 0.5
    weights = np.exp(-0.5 * (rows[:, None] ** 2 + columns**2) / CENTRE**2)
    return float((picture @ LUMINANCE * weights).sum() / weights.sum())


def exposure(light: float, first_light: float, first_gain: float) -> float:
    """Returns the gain of a moment, by what is metered then and at the first moment."""
    return float(first_gain * (first_light / max(light, 1e-9)) ** REACTION)


def white_gain(picture: Picture, person: NDArray[np.bool_]) -> float:
    """Returns the gain that puts the brightest hundredth of the person at `WHITE`."""
    if not person.any():
        return 1.0
    return WHITE / max(float(np.percentile(picture[person].max(axis=1), 99)), 1e-6)


def expose(picture: Picture, gain: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Returns a linear picture as the camera stores it, `[H, W, 3]`, before JPEG."""
    sharp = gain * picture
    light = cv2.GaussianBlur(sharp, (0, 0), SOFTNESS, borderType=cv2.BORDER_REPLICATE)
    spread: Floats = np.sqrt(READ_NOISE**2 + SHOT_NOISE * np.clip(light, 0.0, 1.0))
    noisy = light + spread * rng.standard_normal(light.shape)
    return (255.0 * to_srgb(noisy) + 0.5).astype(np.uint8)
