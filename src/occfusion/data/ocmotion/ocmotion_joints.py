"""Key points that OcMotion's files have themselves, against the joints of the body: is it the person in the picture?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from occfusion.data.checking import checks
from occfusion.data.scene import Array, BodyParameters, Calibration

Posing = Callable[[BodyParameters], tuple[Array, Array]]
"""Gives vertices `[V, 3]` and joints `[24, 3]` in the world, metres."""

COMPARED_FRAMES = 8
"""Frames compared, evenly spread."""

LSP_LIMBS = {0: 8, 1: 5, 4: 4, 5: 7, 6: 21, 7: 19, 10: 18, 11: 20}
"""Ankles, knees, wrists and elbows: number among the 14 key points of LSP, and among SMPL's joints. Hips and shoulders
of the two are other places of the body."""

LSP_COUNT = 14
FAR_OFF = 0.05
"""Of the person's height in pixels: 8 cm. The key points of LSP lie 2 to 3 cm from SMPL's joints."""


def limb_distances(keypoints: Any, joints: Array, camera: Calibration, where: str) -> tuple[Array, float]:
    """Returns distances in pixels of limbs from LSP's key points, and the height of the projected joints.

    Args:
        keypoints: `[14, 2]` in pixels, or `[14, 3]` with a confidence of which 0 is unknown.
        joints: the body's, in the world, `[24, 3]`, metres.
        camera: the camera at the stored size.
        where: what messages call the key points.

    Returns:
        Distances `[N]`, of those that are known and ahead of the camera; height in pixels.

    Raises:
        DataError: something else than 14 points.
    """
    columns = 3 if checks.count_of(keypoints) == 3 * LSP_COUNT else 2
    points = checks.numbers(keypoints, columns * LSP_COUNT, where).reshape(LSP_COUNT, columns)
    pixels, depth = checks.project(joints, camera)
    known = np.any(points[:, :2], axis=1) & np.all(points >= 0, axis=1)
    if columns == 3:
        known = known & (points[:, 2] > 0)
    seen = set(np.flatnonzero(known).tolist())
    pairs = [(a, b) for a, b in LSP_LIMBS.items() if a in seen and depth[b] > 0]
    away = [float(np.linalg.norm(points[a, :2] - pixels[b])) for a, b in pairs]
    return np.array(away), float(np.ptp(pixels[:, 1]))


def limb_warnings(found: Sequence[tuple[Array, float]], where: str) -> list[str]:
    """Returns a sentence where the limbs are far from the key points; nothing where none are known.

    Args:
        found: what `limb_distances` says of several frames.
        where: what the sentence begins with.
    """
    away = np.concatenate([distances for distances, _ in found] or [np.zeros(0)])
    if not len(away):
        return []
    shares = np.concatenate([distances / max(height, 1.0) for distances, height in found])
    if np.median(shares) <= FAR_OFF:
        return []
    return [
        f"{where}: ankles, knees, wrists and elbows of the body are {np.median(away):.0f} pixels from the annotated "
        f"key points (median of {len(away)}, {np.median(shares):.0%} of the person's height; the right body has "
        f"less than {FAR_OFF:.0%}). Check the body file, the person and the cameras."
    ]
