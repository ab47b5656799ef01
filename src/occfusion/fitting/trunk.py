"""The trunk in the landmarks: which way it faces, and how large the person is in the picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from occfusion.footage.landmarks import INDEX, KeyPoints

Floats = NDArray[np.float64]

TRUNK = [INDEX[name] for name in ("left_shoulder", "right_shoulder", "left_hip", "right_hip")]
MIN_CONFIDENCE = 0.2
"""Key points that are less sure are not used."""


def heights(points: KeyPoints) -> Floats:
    """Returns the person's size in each picture, pixels: its median over the clip, less where they are far away."""
    sizes = np.full(len(points), np.nan)
    for k in range(len(points)):
        sure = points.confidence[k] > MIN_CONFIDENCE
        if sure.sum() > 8:
            trunk = points.pixels[k][TRUNK]
            spine = np.linalg.norm(trunk[:2].mean(axis=0) - trunk[2:].mean(axis=0))
            sizes[k] = max(float(np.ptp(points.pixels[k][sure], axis=0).max()), 2.5 * float(spine))
    known = sizes[np.isfinite(sizes)]
    usual = float(np.percentile(known, 80)) if len(known) else 100.0
    return np.full(len(points), max(usual, 8.0))


def trunk_turn(world: Floats) -> Floats:
    """Returns the rotation of the trunk from its landmarks in space: columns left, up, forward of the body."""
    left = world[TRUNK[0]] - world[TRUNK[1]] + world[TRUNK[2]] - world[TRUNK[3]]
    up = world[TRUNK[:2]].mean(axis=0) - world[TRUNK[2:]].mean(axis=0)
    left = left - up * (left @ up) / max(float(up @ up), 1e-9)
    axes = [left / max(float(np.linalg.norm(left)), 1e-9), up / max(float(np.linalg.norm(up)), 1e-9)]
    return np.column_stack([*axes, np.cross(axes[0], axes[1])])


def flat_turn(points: KeyPoints, frame: int) -> Floats:
    """Returns the rotation of the trunk from its landmarks in the picture: facing, turned away, or from the side."""
    trunk = points.pixels[frame][TRUNK]
    up = trunk[:2].mean(axis=0) - trunk[2:].mean(axis=0)
    long = max(float(np.linalg.norm(up)), 1.0)
    up3 = np.array([*(up / long), 0.0])
    side = np.array([-up3[1], up3[0], 0.0])  # to the right of up in the picture
    across = (trunk[0] - trunk[1]) @ side[:2] / (0.7 * long)
    across = float(np.clip(across, -1.0, 1.0))
    face = [INDEX["nose"], INDEX["left_ear"], INDEX["right_ear"]]
    towards = points.pixels[frame][face[0]] - points.pixels[frame][face[1:]].mean(axis=0)
    sign = 1.0 if towards @ side[:2] > 0 else -1.0
    away = np.sqrt(1 - across**2)
    left = across * side + np.array([0.0, 0.0, sign * away])
    return np.column_stack([left, up3, np.cross(left, up3)])
