"""Consistency of masks in time: warping by the body's motion, smoothing along it, and what flickers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.distance import nearest_set
from occfusion.geometry.zbuffer import rasterize_mesh

Floats = NDArray[np.float32]
FLOW_SIZE = 64
"""Samples a side at which the body's motion is kept; it is smooth."""


@dataclass(frozen=True)
class ProjectedMesh:
    """The body mesh as projected in one frame.

    Attributes:
        pixels: projected vertices, `[V, 2]`.
        depths: `[V]`, metres.
    """

    pixels: NDArray[np.float64]
    depths: NDArray[np.float64]


def body_flow(
    now: ProjectedMesh, other: ProjectedMesh, faces: NDArray[np.int64], height: int, width: int
) -> Floats:
    """Returns where each pixel of `now` comes from in `other`, `[H, W, 2]`, pixels (x, y).

    On the body it follows the surface that is seen; beyond, the nearest point of the outline.
    """
    low, high = now.pixels.min(axis=0), now.pixels.max(axis=0)
    margin = 0.15 * float((high - low).max()) + 1.0
    low, high = low - margin, high + margin
    scale = FLOW_SIZE / float((high - low).max())
    seen = rasterize_mesh((now.pixels - low) * scale, now.depths, faces, FLOW_SIZE, FLOW_SIZE)
    there = seen.face >= 0
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).astype(np.float32)
    if not there.any():
        return grid
    shift = np.zeros((FLOW_SIZE, FLOW_SIZE, 2), np.float32)
    corners = faces[seen.face[there]]
    moved = (other.pixels - now.pixels)[corners]
    shift[there] = (moved * seen.barycentrics[there][..., None]).sum(axis=1)
    shift = shift.reshape(-1, 2)[nearest_set(there)]
    at = (grid - low.astype(np.float32)) * np.float32(scale) - np.float32(0.5)
    spread = cv2.remap(shift, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(grid + spread, np.float32)


def warp(picture: Floats, flow: Floats) -> Floats:
    """Returns a picture `[H, W]` of the other frame, seen along `flow`; 0 beyond its edge."""
    x, y = flow[..., 0] - np.float32(0.5), flow[..., 1] - np.float32(0.5)
    return np.asarray(cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT), np.float32)


def smoothed(probability: Floats, neighbours: Sequence[tuple[Floats, Floats]], weight: float = 0.5) -> Floats:
    """Returns a probability averaged with those of neighbouring frames, warped.

    Args:
        probability: of this frame, `[H, W]`.
        neighbours: the probability and the flow of each neighbour.
        weight: of each neighbour; this frame has weight 1.
    """
    total, weights = probability.astype(np.float64), 1.0
    for other, flow in neighbours:
        total = total + weight * warp(other, flow)
        weights += weight
    return np.asarray(total / weights, np.float32)


def warped_iou(
    now: NDArray[np.bool_], other: NDArray[np.bool_], flow: Floats, where: NDArray[np.bool_]
) -> float | None:
    """Returns the IoU, inside `where`, of a mask with the other frame's mask warped to it; None if both are empty."""
    carried = warp(other.astype(np.float32), flow) > 0.5
    union = int(((now | carried) & where).sum())
    return int((now & carried & where).sum()) / union if union else None
