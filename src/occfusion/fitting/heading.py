"""Which way a person faces where the trunk is hidden: from the limbs that are seen, and from the frames about it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.fitting.anchors import landmark_places
from occfusion.fitting.batch import BodyBatch, rotations_of
from occfusion.fitting.trunk import MIN_CONFIDENCE
from occfusion.footage.landmarks import INDEX, KeyPoints

Floats = NDArray[np.float64]

HEADINGS = 24
"""Headings that are tried, evenly spread over the circle."""
FAR = 0.15
"""Distance, in metres, at which a landmark is half believed: limbs move, and here they hang."""
TURN = np.radians(30.0)
"""Change of heading between two frames that costs `CHANGE`."""
CHANGE = 0.1
FEWEST = 4
"""Fewer landmarks say nothing about a heading."""
SURE = 2.0
"""Weight of a heading that the trunk itself shows."""


def facing(turn: Floats) -> float:
    """Returns the heading of a trunk's rotation `[3, 3]`, radians: 0 towards the camera, positive to the right."""
    return float(np.arctan2(turn[0, 2], -turn[2, 2]))


def upright(heading: float) -> Floats:
    """Returns the rotation `[3, 3]` of an upright body that faces that way."""
    c, s = np.cos(heading), np.sin(heading)
    return np.diag([1.0, -1.0, -1.0]) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def cheapest_path(cost: Floats, step: Floats) -> NDArray[np.int64]:
    """Returns the states `[N]` whose costs `[N, S]` and changes `[S, S]` (from, to) cost least together (Viterbi)."""
    total, back = cost[0], []
    for row in cost[1:]:
        way = total[:, None] + step
        back.append(way.argmin(axis=0))
        total = way.min(axis=0) + row
    path = [int(total.argmin())]
    for choice in reversed(back):
        path.append(int(choice[path[-1]]))
    return np.array(path[::-1])


def hidden_headings(
    points: KeyPoints,
    known: dict[int, float],
    pixels_per_metre: Floats,
    batch: BodyBatch,
    pose: Tensor,
    shape: Tensor,
) -> tuple[Floats, Floats]:
    """Returns headings `[N]`, radians, and the middles of the hips `[N, 2]`, pixels; NaN where nothing says them.

    The cheapest path through the headings of all frames: a heading costs how far the landmarks of a usual
    pose are from those that are seen, wherever the person stands; a change costs its square.

    Args:
        points: key points.
        known: headings of the frames whose trunk is seen.
        pixels_per_metre: at the person's distance, `[N]`.
        batch: the body.
        pose: a usual one, `[69]`.
        shape: of the body, `[B]`.
    """
    count = len(points)
    rotations = rotations_of(torch.zeros(1, 3), pose[None])
    marks = landmark_places(*batch.transforms(shape, rotations, torch.zeros(1, 3)))[0].double().numpy()
    hips = marks[[INDEX["left_hip"], INDEX["right_hip"]]].mean(axis=0)
    angles = np.arange(HEADINGS) * 2 * np.pi / HEADINGS
    flat = np.stack([((marks - hips) @ upright(angle).T)[:, :2] for angle in angles])
    cost, middles = np.zeros((count, HEADINGS)), np.full((count, HEADINGS, 2), np.nan)
    for k in range(count):
        sure = (points.confidence[k] > MIN_CONFIDENCE) & (points.presence[k] > 0)
        if k in known:
            cost[k] = SURE * (1 - np.cos(angles - known[k]))
        elif sure.sum() >= FEWEST:
            shift = points.pixels[k, sure] - pixels_per_metre[k] * flat[:, sure]
            middles[k] = np.median(shift, axis=1)
            off = np.linalg.norm(shift - middles[k][:, None], axis=2) / pixels_per_metre[k]
            cost[k] = (off**2 / (off**2 + FAR**2)).mean(axis=1)
    apart = np.abs((angles[:, None] - angles + np.pi) % (2 * np.pi) - np.pi)
    step = CHANGE * (apart / TURN) ** 2
    chosen = cheapest_path(cost, step)
    headings, places = angles[chosen], middles[np.arange(count), chosen]
    headings = np.where(np.isfinite(places[:, 0]), headings, np.nan)
    return headings, places
