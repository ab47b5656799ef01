"""Key points of a person, under the names and in the order of MediaPipe's 33 pose landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

NAMES = (
    "nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer",
    "left_ear", "right_ear", "mouth_left", "mouth_right", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_pinky", "right_pinky", "left_index", "right_index",
    "left_thumb", "right_thumb", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle",
    "left_heel", "right_heel", "left_foot_index", "right_foot_index",
)  # fmt: skip
INDEX = {name: place for place, name in enumerate(NAMES)}
COUNT = len(NAMES)


def _mirrored(name: str) -> str:
    if "left" in name:
        return name.replace("left", "right")
    return name.replace("right", "left")


MIRRORED = np.array([INDEX[_mirrored(name)] for name in NAMES])
"""Of each landmark the one on the other side, `[33]`."""
ARMS, LEGS = np.arange(INDEX["left_shoulder"], INDEX["left_hip"]), np.arange(INDEX["left_hip"], COUNT)
"""Shoulders to fingers, and hips to toes."""
LIMBS = np.concatenate([ARMS, LEGS])
"""Landmarks by which sides are told."""

BONES = (
    (11, 12), (11, 13), (13, 15), (12, 14), (14, 16), (11, 23), (12, 24), (23, 24), (23, 25), (25, 27), (24, 26),
    (26, 28), (27, 29), (29, 31), (27, 31), (28, 30), (30, 32), (28, 32), (15, 19), (16, 20), (0, 7), (0, 8),
)  # fmt: skip
"""Pairs that are drawn as lines."""


@dataclass(frozen=True)
class KeyPoints:
    """Key points of one person over the frames of a clip.

    Attributes:
        pixels: `[N, 33, 2]`, the middle of the first pixel is 0.5; anything where confidence is 0.
        confidence: that the point is in the picture and not hidden, `[N, 33]`, 0..1.
        world: metric and from the middle of the hips, axes as the camera's (x right, y down, z away),
            `[N, 33, 3]`; None where the source has no depth.
        presence: that there is a person at all, `[N]`, 0..1.
    """

    pixels: Floats
    confidence: Floats
    world: Floats | None
    presence: Floats

    def __len__(self) -> int:
        """Returns the number of frames."""
        return len(self.pixels)

    def at(self, places: Sequence[int]) -> KeyPoints:
        """Returns some of the frames."""
        rows = list(places)
        world = None if self.world is None else self.world[rows]
        return KeyPoints(self.pixels[rows], self.confidence[rows], world, self.presence[rows])
