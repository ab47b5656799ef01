"""How far one outline lies from another, point by point and to fractions of a pixel.

Both masks are blurred alike and followed along the normal of the first; where each falls through one half is its
edge. What sampling and blurring do to an edge, they do to both, and it drops out of the difference.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.cpu.compilation import inline, kernel

Floats = NDArray[np.float64]

BLUR = 1.0
"""Standard deviation in pixels: staircases of a binary mask become edges whose place is known to a few hundredths."""
STEP = 0.25
"""Pixels between samples along a normal."""
AWAY_FROM_BORDER = 2.0
"""Pixels from the picture's border within which an edge may be the border itself."""
SAME_DIRECTION = 0.7
"""Cosine: edges that run another way than the outline are somebody else's, an occluder's for example."""
THINNED = 0.4
"""Share of a long outline's points: they lie two to three pixels apart then, and err less alike."""
PLASTIC = 1.32471795724474602596
"""Root of x^3 = x + 1: multiples of its inverse and of that one's square spread over a plane as evenly as can be, along
any line of pixels (Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018)."""
NEAR_ITS_PIXEL = 2.0
"""Pixels within which the first outline must be found again; it is not on parts that the blur wipes out."""


class OutlineOffsets(NamedTuple):
    """Points of an outline where the other one was found.

    Attributes:
        points: on the first outline, `[N, 2]`, pixels (centres at +0.5).
        normals: pointing out of the first mask, `[N, 2]`.
        offsets: from the first outline to the second along the normal, `[N]`, pixels.
        pixels: row and column of the first mask's pixel at each point, `[N, 2]`.
    """

    points: Floats
    normals: Floats
    offsets: Floats
    pixels: NDArray[np.int64]


def outline_offsets(
    coverage: NDArray[np.floating], seen: NDArray[np.bool_], reach: float, least: int | None = None
) -> OutlineOffsets:
    """Returns where the outline of `seen` lies beside that of `coverage`.

    Points without an edge of the same direction within `reach` are left out: what is hidden, or differs.

    Args:
        coverage: share of each pixel that the first mask covers, `[H, W]`, 0..1.
        seen: the second mask, `[H, W]`.
        reach: farthest offset that is looked for, pixels.
        least: points of an outline that are looked at, about; of a longer one these or `THINNED` of it, whichever are
            more, evenly spread. None: all.
    """
    inside = (coverage > 0.5).astype(np.uint8)
    core = cv2.erode(inside, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    rows, columns = np.nonzero(inside > np.asarray(core))
    if least is not None and len(rows) > least:
        spread = (rows / PLASTIC + columns / PLASTIC**2) % 1.0
        chosen = spread < max(THINNED, least / len(rows))
        rows, columns = rows[chosen], columns[chosen]
    if not len(rows):
        nothing = np.zeros((0, 2))
        return OutlineOffsets(nothing, nothing, np.zeros(0), nothing.astype(np.int64))
    first, second = _blurred(coverage), _blurred(seen)
    middles = np.column_stack([columns + 0.5, rows + 0.5])
    normals = -_gradient(first, middles)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    own = _crossings(first, middles, normals, min(reach, NEAR_ITS_PIXEL + STEP), np.zeros(len(middles)))
    # comparisons with NaN, which stands for an edge that was not found, are false
    known = np.flatnonzero(np.abs(own) < NEAR_ITS_PIXEL)
    pixels = np.column_stack([rows, columns])[known]
    middles, normals, own = middles[known], normals[known], own[known]
    other = _crossings(second, middles, normals, reach, own)
    found = np.flatnonzero(np.abs(other) <= reach)
    pixels, middles, normals, own, other = (
        pixels[found], middles[found], normals[found], own[found], other[found]
    )  # fmt: skip
    ends = middles + normals * other[:, None]
    slopes = -_gradient(second, ends)
    cosines = (slopes * normals).sum(axis=1) / np.maximum(np.linalg.norm(slopes, axis=1), 1e-9)
    height, width = seen.shape
    is_inside = (ends > AWAY_FROM_BORDER).all(axis=1) & (
        ends < np.array([width, height]) - AWAY_FROM_BORDER
    ).all(axis=1)
    kept = np.flatnonzero(is_inside & (cosines > SAME_DIRECTION))
    return OutlineOffsets(
        points=(middles + normals * own[:, None])[kept],
        normals=normals[kept],
        offsets=(other - own)[kept],
        pixels=pixels[kept],
    )


def _blurred(mask: NDArray[np.generic]) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), BLUR))


def _gradient(image: NDArray[np.float32], points: Floats) -> Floats:
    out = np.zeros_like(points)
    _fill_gradients(image, points, out)
    return out


def _crossings(
    image: NDArray[np.float32], points: Floats, normals: Floats, reach: float, near: Floats
) -> Floats:
    out = np.full(len(points), np.nan)
    _fill_crossings(image, points, normals, math.ceil(reach / STEP), near, out)
    return out


@inline
def _sampled(image: NDArray[np.float32], x: float, y: float) -> float:
    """Returns the image at a place between pixel centres, bilinearly; beyond its border, what is there."""
    height, width = image.shape
    x, y = min(max(x - 0.5, 0.0), width - 1.0), min(max(y - 0.5, 0.0), height - 1.0)
    column, row = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
    right, below = min(column + 1, width - 1), min(row + 1, height - 1)
    x, y = x - column, y - row
    above = (1.0 - x) * image[row, column] + x * image[row, right]
    return float((1.0 - y) * above + y * ((1.0 - x) * image[below, column] + x * image[below, right]))


@kernel
def _fill_gradients(image: NDArray[np.float32], points: Floats, out: Floats) -> None:
    """Gives the gradient of a mask at points, by Sobel's weights: eight times that of a step between pixels."""
    for k in range(len(points)):
        x, y = points[k, 0], points[k, 1]
        for side in range(-1, 2):
            weight = 2.0 if side == 0 else 1.0
            out[k, 0] += weight * (_sampled(image, x + 1.0, y + side) - _sampled(image, x - 1.0, y + side))
            out[k, 1] += weight * (_sampled(image, x + side, y + 1.0) - _sampled(image, x + side, y - 1.0))


@kernel
def _fill_crossings(
    image: NDArray[np.float32], points: Floats, normals: Floats, steps: int, near: Floats, out: Floats
) -> None:
    """Gives how far along its normal each point's nearest fall through one half lies.

    Args:
        image: a blurred mask.
        points: `[N, 2]`.
        normals: `[N, 2]`.
        steps: of `STEP`, that are looked at in either direction.
        near: the crossing nearest to this is taken, `[N]`.
        out: NaN where there is none, `[N]`.
    """
    for k in range(len(points)):
        x, y, u, v = points[k, 0], points[k, 1], normals[k, 0], normals[k, 1]
        least = np.inf
        before = _sampled(image, x - steps * STEP * u, y - steps * STEP * v)
        for step in range(-steps, steps):
            along = (step + 1) * STEP
            behind = _sampled(image, x + along * u, y + along * v)
            if before >= 0.5 and behind < 0.5:
                place = step * STEP + STEP * (before - 0.5) / max(before - behind, 1e-9)
                if abs(place - near[k]) < least:
                    least = abs(place - near[k])
                    out[k] = place
            before = behind
