"""Whether a surface is closed, and whether a point is within it: the winding number."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def winding_number(
    point: NDArray[np.floating], vertices: NDArray[np.floating], faces: NDArray[np.integer]
) -> float:
    """Returns how often a surface goes round a point: about 1 within a closed one, 0 without.

    The sum of the solid angles of the triangles (van Oosterom and Strackee 1983, eq. 8) over that of the sphere. Small
    holes change it little.

    Args:
        point: `[3]`.
        vertices: `[V, 3]`.
        faces: `[F, 3]`, counter-clockwise from without.
    """
    a, b, c = np.moveaxis((vertices - point)[faces].astype(np.float64), 1, 0)
    la, lb, lc = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    triple = np.einsum("fi,fi->f", a, np.cross(b, c))
    dots = [np.einsum("fi,fi->f", p, q) for p, q in ((a, b), (b, c), (c, a))]
    below = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return float(np.arctan2(triple, below).sum() / (2 * np.pi))


def is_closed(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> bool:
    """Returns whether a surface has no edge, and corners of its triangles run counter-clockwise seen from without.

    Args:
        vertices: `[V, 3]`.
        faces: `[F, 3]`.
    """
    if not len(faces):
        return False
    starts, ends = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    there, back = np.sort(starts * len(vertices) + ends), np.sort(ends * len(vertices) + starts)
    if not np.array_equal(there, back):
        return False
    a, b, c = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c))) > 0.0
