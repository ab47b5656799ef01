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

Floats = NDArray[np.float64]

BLUR = 1.0
"""Standard deviation in pixels: staircases of a binary mask become edges whose place is known to a few hundredths."""
STEP = 0.25
"""Pixels between samples along a normal."""
AWAY_FROM_BORDER = 2.0
"""Pixels from the picture's border within which an edge may be the border itself."""
SAME_DIRECTION = 0.7
"""Cosine: edges that run another way than the outline are somebody else's, an occluder's for example."""
MOST_ROWS = 30_000
"""OpenCV resamples no more than 32766 rows at a time."""
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
    distances = np.arange(-reach, reach + 0.5 * STEP, STEP)
    near = distances[np.abs(distances) < NEAR_ITS_PIXEL + 2 * STEP]
    own = _crossings(first, middles, normals, near, np.zeros(len(middles)))
    other = _crossings(second, middles, normals, distances, np.nan_to_num(own))
    ends = middles + normals * np.nan_to_num(other)[:, None]
    slopes = -_gradient(second, ends)
    cosines = (slopes * normals).sum(axis=1) / np.maximum(np.linalg.norm(slopes, axis=1), 1e-9)
    height, width = seen.shape
    is_inside = (ends > AWAY_FROM_BORDER).all(axis=1) & (
        ends < np.array([width, height]) - AWAY_FROM_BORDER
    ).all(axis=1)
    # comparisons with NaN, which stands for an edge that was not found, are false
    is_found = (np.abs(own) < NEAR_ITS_PIXEL) & (np.abs(other) <= reach)
    kept = np.flatnonzero(is_found & is_inside & (cosines > SAME_DIRECTION))
    return OutlineOffsets(
        points=(middles + normals * np.nan_to_num(own)[:, None])[kept],
        normals=normals[kept],
        offsets=(other - own)[kept],
        pixels=np.column_stack([rows, columns])[kept],
    )


def _blurred(mask: NDArray[np.generic]) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), BLUR))


def _sampled(
    image: NDArray[np.float32], x: NDArray[np.float32], y: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Returns the image at places `[N, M]` between pixel centres, pixels, bilinearly."""
    parts = max(1, math.ceil(len(x) / MOST_ROWS))
    rows = [
        np.asarray(cv2.remap(image, *part, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)
        for part in zip(np.array_split(x, parts), np.array_split(y, parts), strict=True)
    ]
    return rows[0] if parts == 1 else np.concatenate(rows)


def _gradient(image: NDArray[np.float32], points: Floats) -> Floats:
    x, y = (points.T[..., None] - 0.5).astype(np.float32)
    parts = [
        np.asarray(cv2.Sobel(image, cv2.CV_32F, *order, ksize=3), np.float32) for order in ((1, 0), (0, 1))
    ]
    return np.concatenate([_sampled(part, x, y) for part in parts], axis=1).astype(np.float64)


def _crossings(
    image: NDArray[np.float32], points: Floats, normals: Floats, distances: Floats, near: Floats
) -> Floats:
    """Returns how far along its normal each point's nearest fall through one half lies, `[N]`; NaN where there is none.

    Args:
        image: a blurred mask.
        points: `[N, 2]`.
        normals: `[N, 2]`.
        distances: sampled, ascending.
        near: the crossing nearest to this is taken, `[N]`.
    """
    starts, steps = ((part.T[..., None]).astype(np.float32) for part in (points - 0.5, normals))
    profile = _sampled(image, *(starts + steps * distances.astype(np.float32)))
    row, step = np.nonzero((profile[:, :-1] >= 0.5) & (profile[:, 1:] < 0.5))
    left, right = (profile[row, at].astype(np.float64) for at in (step, step + 1))
    places = distances[step] + STEP * (left - 0.5) / np.maximum(left - right, 1e-9)
    order = np.lexsort((np.abs(places - near[row]), row))  # the nearest of each point first
    row, places = row[order], places[order]
    is_first = np.diff(row, prepend=-1) > 0
    out = np.full(len(points), np.nan)
    out[row[is_first]] = places[is_first]
    return out
