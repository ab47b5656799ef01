"""`boxes.points_bounds` and `boxes.mask_bounds` in one pass each, nothing allocated."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from occfusion.cpu.compilation import kernel


def warm_up() -> None:
    """Compiles the kernels, or loads them from the cache: by no point and an empty mask."""
    points, viewmat, K = (np.zeros(shape, np.float32) for shape in ((0, 3), (4, 4), (3, 3)))
    bounds_of_points(points, viewmat, K, 0.0, 0.0)
    bounds_of_mask(np.zeros((1, 1), np.bool_))


@kernel
def bounds_of_points(
    points: NDArray[np.float32],
    viewmat: NDArray[np.float32],
    K: NDArray[np.float32],
    near: float,
    most: float,
) -> tuple[int, int, int, int, int]:
    """Returns how many points lie in front, and left, top, right and bottom of their places in the picture.

    What is not a number is left out by every comparison, as where nothing lies in front.
    """
    count = 0
    left, top, right, bottom = (
        np.float32(np.inf),
        np.float32(np.inf),
        np.float32(-np.inf),
        np.float32(-np.inf),
    )
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        depth = viewmat[2, 0] * x + viewmat[2, 1] * y + viewmat[2, 2] * z + viewmat[2, 3]
        if not depth > near:
            continue
        count += 1
        a = (viewmat[0, 0] * x + viewmat[0, 1] * y + viewmat[0, 2] * z + viewmat[0, 3]) / depth
        b = (viewmat[1, 0] * x + viewmat[1, 1] * y + viewmat[1, 2] * z + viewmat[1, 3]) / depth
        u = K[0, 0] * a + K[0, 1] * b + K[0, 2]
        v = K[1, 0] * a + K[1, 1] * b + K[1, 2]
        left, right = min(left, u), max(right, u)
        top, bottom = min(top, v), max(bottom, v)
    if count == 0:
        return 0, 0, 0, 0, 0
    # beyond this the exact value no longer matters, and whole numbers of it stay small
    bound = np.float32(most)
    left, top = max(min(left, bound), -bound), max(min(top, bound), -bound)
    right, bottom = max(min(right, bound), -bound), max(min(bottom, bound), -bound)
    return count, math.floor(left), math.floor(top), math.ceil(right), math.ceil(bottom)


@kernel
def bounds_of_mask(mask: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """Returns left, top, right and bottom of the true pixels, ends exclusive; right is 0 where there are none."""
    height, width = mask.shape
    left, top, right, bottom = width, height, 0, 0
    for y in range(height):
        first = 0
        while first < width and not mask[y, first]:
            first += 1
        if first == width:
            continue
        last = width
        while not mask[y, last - 1]:
            last -= 1
        left, right = min(left, first), max(right, last)
        top, bottom = min(top, y), y + 1
    return left, top, right, bottom
