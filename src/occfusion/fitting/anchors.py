"""Where the 33 landmarks lie on a body with SMPL's joints.

A landmark is a joint and an offset in the frame of a bone: a model trained on people's pictures puts hips, shoulders
and ears elsewhere than a body model its joints. Offsets and spreads are measured on rendered embedded people with
numbers below 100 (`scripts/calibrate_landmarks.py`); offsets scale with the body.
"""

from __future__ import annotations

import torch
from torch import Tensor

from occfusion.footage.landmarks import MIRRORED

ANCHORS: tuple[tuple[int, int], ...] = (
    *((15, 15),) * 11, (16, 9), (17, 9), (18, 16), (19, 17), (20, 18), (21, 19), (20, 20), (21, 21), (20, 20),
    (21, 21), (20, 20), (21, 21), (1, 0), (2, 0), (4, 1), (5, 2), (7, 4), (8, 5), (7, 7), (8, 8), (7, 7), (8, 8),
)  # fmt: skip
"""Of each landmark the joint it lies at, and the joint whose rotation turns its offset."""

_LEFT = {
    0: (0.001, 0.080, 0.139, 0.019),
    1: (0.014, 0.112, 0.112, 0.017),
    2: (0.024, 0.112, 0.107, 0.017),
    3: (0.034, 0.111, 0.101, 0.017),
    7: (0.052, 0.091, 0.054, 0.013),
    9: (0.018, 0.042, 0.123, 0.017),
    11: (-0.001, 0.025, 0.005, 0.014),
    13: (-0.013, 0.001, 0.007, 0.013),
    15: (0.010, -0.002, 0.003, 0.011),
    17: (0.089, -0.008, -0.009, 0.014),
    19: (0.094, -0.011, 0.018, 0.013),
    21: (0.069, -0.014, 0.028, 0.015),
    23: (-0.014, -0.011, 0.031, 0.019),
    25: (-0.005, 0.009, -0.008, 0.016),
    27: (0.000, 0.035, 0.007, 0.014),
    29: (0.000, -0.037, -0.039, 0.018),
    31: (-0.006, -0.046, 0.191, 0.019),
}
"""Of the left landmarks and the nose: offset x, y, z and spread, metres."""


def _table() -> tuple[list[list[float]], list[float]]:
    offsets, spreads = [], []
    for k in range(len(ANCHORS)):
        x, y, z, spread = _LEFT[k if k in _LEFT else int(MIRRORED[k])]
        offsets.append([x if k in _LEFT else -x, y, z])
        spreads.append(spread)
    return offsets, spreads


OFFSETS, SPREADS = _table()
"""Offsets `[33, 3]` and spreads `[33]` of all landmarks, metres."""
_JOINTS = [joint for joint, _ in ANCHORS]
_FRAMES = [frame for _, frame in ANCHORS]


def landmark_places(turns: Tensor, places: Tensor) -> Tensor:
    """Returns where the landmarks of bodies are, `[N, 33, 3]`, metres.

    Args:
        turns: rotations of the joints in the world, `[N, 24, 3, 3]`.
        places: of the joints, `[N, 24, 3]`.
    """
    offsets = torch.tensor(OFFSETS, dtype=places.dtype, device=places.device)
    return places[:, _JOINTS] + (turns[:, _FRAMES] @ offsets[..., None])[..., 0]
