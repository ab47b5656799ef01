"""Which way a person faces, and which side is which, told from the landmarks.

Where the trunk is hidden its heading comes from the limbs that are seen, and from the frames about it. A model at times
takes the left side of a person for the right one.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.fitting.anchors import landmark_places
from occfusion.fitting.batch import BodyBatch, rotations_of
from occfusion.footage.landmarks import INDEX, LIMBS, MIRRORED, KeyPoints

Floats = NDArray[np.float64]

TRUNK = [INDEX[name] for name in ("left_shoulder", "right_shoulder", "left_hip", "right_hip")]
MIN_CONFIDENCE = 0.2
"""Key points that are less sure are not used."""
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
SWITCH = 0.012
"""Cost of changing between as-given and swapped, in heights of the person by which each landmark jumps."""
KEPT = 0.02
"""Cost of a swapped frame: where both are as smooth, what the model said stands."""


def heights(points: KeyPoints) -> Floats:
    """Returns the person's size in each picture, pixels: one for the whole clip, that of its larger pictures."""
    sizes = []
    for pixels, confidence in zip(points.pixels, points.confidence, strict=True):
        sure = confidence > MIN_CONFIDENCE
        if sure.sum() > 8:
            trunk = pixels[TRUNK]
            spine = np.linalg.norm(trunk[:2].mean(axis=0) - trunk[2:].mean(axis=0))
            sizes.append(max(float(np.ptp(pixels[sure], axis=0).max()), 2.5 * float(spine)))
    usual = float(np.percentile(sizes, 80)) if sizes else 100.0
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


def facing(turn: Floats) -> float:
    """Returns the heading of a trunk's rotation `[3, 3]`, radians: 0 towards the camera, positive to the right."""
    return float(np.arctan2(turn[0, 2], -turn[2, 2]))


def upright(heading: float) -> Floats:
    """Returns the rotation `[3, 3]` of an upright body that faces that way."""
    c, s = np.cos(heading), np.sin(heading)
    return np.diag([1.0, -1.0, -1.0]) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def cheapest_path(cost: Floats, step: Floats) -> NDArray[np.int64]:
    """Returns the states `[N]` whose costs and changes cost least together (Viterbi).

    Args:
        cost: of each state, `[N, S]`.
        step: from a state to the next, `[S, S]`; or of each change its own, `[N - 1, S, S]`.
    """
    total, back = cost[0], []
    for row, change in zip(cost[1:], np.broadcast_to(step, (len(cost) - 1, *step.shape[-2:])), strict=True):
        way = total[:, None] + change
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
    sure = points.confidence[seen][:, LIMBS]
    size = np.ptp(points.pixels[seen][:, LIMBS], axis=1).max(axis=1).clip(1.0)
    flat = points.pixels[seen] / np.median(size)
    parts = [flat] if points.world is None else [flat, points.world[seen] / 1.7]
    states = [np.concatenate([part[:, LIMBS] for part in parts], axis=2)]
    states.append(np.concatenate([part[:, MIRRORED][:, LIMBS] for part in parts], axis=2))
    steps = np.empty((len(seen) - 1, 2, 2))
    for k in range(1, len(seen)):
        weight = np.minimum(sure[k], sure[k - 1])
        weight = weight / max(float(weight.sum()), 1e-6)
        gap = seen[k] - seen[k - 1]
        for a, b in product(range(2), repeat=2):
            jump = np.linalg.norm(states[b][k] - states[a][k - 1], axis=1)
            moved = (weight * np.minimum(jump, 0.5)).sum() / gap
            steps[k - 1, a, b] = moved + KEPT * b + SWITCH * (a != b)
    cost = np.zeros((len(seen), 2))
    cost[0, 1] = KEPT
    out[seen] = cheapest_path(cost, steps) == 1
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
