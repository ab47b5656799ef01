"""The body mesh as a camera sees it: silhouette and depth for the prior, z-buffer for the joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.sampled_mesh import SampledMesh, box_of

DEPTH_RANGE = 0.7
"""Metres before and behind the middle of the body over which depth runs from -1 to 1."""


@dataclass(frozen=True)
class BodyView:
    """What a camera sees of the body.

    Attributes:
        coverage: share of each pixel that the body covers, `[H, W]`, 0..1.
        relative_depth: depth from the middle of the body in units of `DEPTH_RANGE`, clipped to -1..1, nearest
            sample of a pixel; 0 where the body is not.
        depth: depth of the nearest sample, `[H, W]`, metres; infinite where the body is not.
    """

    coverage: NDArray[np.float32]
    relative_depth: NDArray[np.float32]
    depth: NDArray[np.float32]


def view_body(
    pixels: NDArray[np.floating],
    depths: NDArray[np.floating],
    faces: NDArray[np.integer],
    width: int,
    height: int,
) -> BodyView:
    """Returns the body in a picture of `width` x `height` pixels.

    Args:
        pixels: projected vertices, `[V, 2]`.
        depths: `[V]`, metres.
        faces: `[F, 3]`.
        width: columns.
        height: rows.
    """
    x, y, w, h = box = box_of(pixels, width, height)
    drawn, window = SampledMesh.draw(pixels, depths, faces, box), np.s_[y : y + h, x : x + w]
    depth, coverage = np.full((height, width), np.inf, np.float32), np.zeros((height, width), np.float32)
    depth[window], coverage[window] = drawn.nearest, drawn.coverage
    middle = 0.5 * (float(np.min(depths)) + float(np.max(depths)))
    relative = np.where(np.isfinite(depth), np.clip((depth - middle) / DEPTH_RANGE, -1.0, 1.0), 0.0)
    return BodyView(coverage, relative.astype(np.float32), depth)
