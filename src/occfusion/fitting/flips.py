"""Frames in which a model took the left side of a person for the right one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from occfusion.footage.landmarks import MIRRORED, KeyPoints

_LIMBS = np.arange(11, 33)
"""Landmarks that tell: shoulders to toes."""
SWITCH = 0.6
"""Cost of changing between as-given and swapped, in heights of the person per landmark summed."""
KEPT = 0.02
"""Cost of a swapped frame: where both are as smooth, what the model said stands."""


def swapped_frames(points: KeyPoints) -> NDArray[np.bool_]:
    """Returns the frames whose left and right are to be exchanged for the motion to be continuous, `[N]`.

    The cheapest path through two states a frame (Viterbi): going from one frame to the next costs how far the limbs
    jump in the picture and, where there is depth, in space, relative to the person's size.
    """
    count = len(points)
    seen = np.flatnonzero(points.presence > 0)
    out = np.zeros(count, dtype=bool)
    if len(seen) < 3:
        return out
    sure = points.confidence[seen][:, _LIMBS]
    size = np.ptp(points.pixels[seen][:, _LIMBS], axis=1).max(axis=1).clip(1.0)
    flat = points.pixels[seen] / np.median(size)
    parts = [flat]
    if points.world is not None:
        parts.append(points.world[seen] / 1.7)
    states = [np.concatenate([part[:, _LIMBS] for part in parts], axis=2)]
    states.append(np.concatenate([part[:, MIRRORED][:, _LIMBS] for part in parts], axis=2))
    cost, back = np.array([0.0, KEPT]), []
    for k in range(1, len(seen)):
        weight = np.minimum(sure[k], sure[k - 1])
        weight = weight / max(float(weight.sum()), 1e-6)
        gap = seen[k] - seen[k - 1]
        step = np.empty((2, 2))
        for a in range(2):
            for b in range(2):
                jump = np.linalg.norm(states[b][k] - states[a][k - 1], axis=1)
                step[a, b] = (
                    (weight * np.minimum(jump, 0.5)).sum() / gap + KEPT * b + 0.02 * SWITCH * (a != b)
                )
        total = cost[:, None] + step
        back.append(total.argmin(axis=0))
        cost = total.min(axis=0)
    state = int(cost.argmin())
    for k in range(len(seen) - 1, -1, -1):
        out[seen[k]] = bool(state)
        if k:
            state = int(back[k - 1][state])
    return out


def exchanged(points: KeyPoints, frames: NDArray[np.bool_]) -> KeyPoints:
    """Returns the key points with left and right exchanged in some frames."""
    order = np.where(frames[:, None], MIRRORED[None], np.arange(len(MIRRORED))[None])
    rows = np.arange(len(frames))[:, None]
    return KeyPoints(
        points.pixels[rows, order],
        points.confidence[rows, order],
        None if points.world is None else points.world[rows, order],
        points.presence,
    )
