"""A correction of the landmarks in space, learned on rendered embedded people with numbers below 100.

The landmark model sees depth with errors that repeat: limbs are drawn towards the trunk, and people lean. A network of
three layers says from a frame's landmarks how far each is off (`scripts/train_landmark_lift.py`); of the picture it
knows nothing. The picture is turned for it until the trunk is upright.
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
SHOULDERS = [INDEX["left_shoulder"], INDEX["right_shoulder"]]
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
    turns = turned_upright(points.pixels[seen])
    around = np.pad(turns, ((0, 0), (0, 1), (0, 1)))
    around[:, 2, 2] = 1.0
    upright = world[seen] @ around.transpose(0, 2, 1)
    values = inputs(upright, points.pixels[seen] @ turns.transpose(0, 2, 1), points.confidence[seen])
    layers = _layers()
    for k, (weight, bias) in enumerate(layers):
        values = values @ weight.T + bias
        if k < len(layers) - 1:
            values = values / (1 + np.exp(-values))
    world[seen] = (from_hips(upright) + MOST * np.tanh(values.reshape(-1, COUNT, 3))) @ around
    return KeyPoints(points.pixels, points.confidence, world, points.presence)


def turned_upright(pixels: Floats) -> Floats:
    """Returns the turns of the picture after which trunks stand upright in it, `[N, 2, 2]`, for landmarks `[N, 33, 2]`.

    What the network learned from are level cameras and people who stand; a camera may be held at any angle.
    """
    up = pixels[:, SHOULDERS].mean(axis=1) - pixels[:, HIPS].mean(axis=1)
    angle = np.arctan2(up[:, 0], -up[:, 1])
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cosine, sine], axis=1), np.stack([-sine, cosine], axis=1)], axis=1)


@cache
def _layers() -> list[tuple[Floats, Floats]]:
    with (
        resources.as_file(resources.files("occfusion") / "assets" / ASSET) as path,
        np.load(path, allow_pickle=False) as file,
    ):
        content = {key: np.asarray(file[key], dtype=np.float64) for key in file.files}
    return [(content[f"weight{k}"], content[f"bias{k}"]) for k in range(len(content) // 2)]
