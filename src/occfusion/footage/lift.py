"""A correction of the landmarks in space, learned on rendered embedded people with numbers below 100.

The landmark model sees depth with errors that repeat: limbs are drawn towards the trunk, and people lean. A network of
three layers says from a frame's landmarks how far each is off (`scripts/train_landmark_lift.py`); of the picture it
knows nothing.
"""

from __future__ import annotations

from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from occfusion.footage.landmarks import COUNT, INDEX, KeyPoints

Floats = NDArray[np.float64]

ASSET = "landmark_lift.npz"
MOST = 0.3
"""Metres by which a landmark is moved at most, along each axis."""
HIPS = [INDEX["left_hip"], INDEX["right_hip"]]
WORLD_SCALE = 3.0
"""Metres are multiplied by it, so that all inputs are about as large."""


def from_hips(points: Floats) -> Floats:
    """Returns points `[N, 33, D]` relative to the middle of the hips."""
    return np.asarray(points - points[:, HIPS].mean(axis=1, keepdims=True))


def inputs(world: Floats, pixels: Floats, confidence: Floats) -> Floats:
    """Returns what the network sees of frames, `[N, 198]`: all but the person's place and size in the picture."""
    spread = pixels - pixels.mean(axis=1, keepdims=True)
    size = np.sqrt((spread**2).sum(axis=2).mean(axis=1)).clip(1e-6)[:, None, None]
    parts = (WORLD_SCALE * from_hips(world), from_hips(pixels) / size, confidence)
    return np.concatenate([part.reshape(len(world), -1) for part in parts], axis=1)


def lifted(points: KeyPoints) -> KeyPoints:
    """Returns key points whose places in space are corrected; others are left as they are."""
    if points.world is None or not len(points):
        return points
    seen = points.presence > 0
    world = points.world.copy()
    values = inputs(world[seen], points.pixels[seen], points.confidence[seen])
    layers = _layers()
    for k, (weight, bias) in enumerate(layers):
        values = values @ weight.T + bias
        if k < len(layers) - 1:
            values = values / (1 + np.exp(-values))
    world[seen] = from_hips(world[seen]) + MOST * np.tanh(values.reshape(-1, COUNT, 3))
    return KeyPoints(points.pixels, points.confidence, world, points.presence)


@cache
def _layers() -> list[tuple[Floats, Floats]]:
    with (
        resources.as_file(resources.files("occfusion") / "assets" / ASSET) as path,
        np.load(path, allow_pickle=False) as file,
    ):
        content = {key: np.asarray(file[key], dtype=np.float64) for key in file.files}
    return [(content[f"weight{k}"], content[f"bias{k}"]) for k in range(len(content) // 2)]
