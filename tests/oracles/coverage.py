"""Which places of a mesh a camera sees, by one line of sight a vertex against every triangle; directions by loops."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def sees(point: Floats, centre: Floats, points: Floats, faces: NDArray[np.int64]) -> bool:
    """Says whether nothing lies between a vertex and the camera (triangles that have the vertex do not count)."""
    for corners in points[faces]:
        if any(np.allclose(corner, point, atol=1e-12) for corner in corners):
            continue
        a, b, c = corners
        # point + t (centre - point) = a + u (b - a) + v (c - a)
        matrix = np.column_stack([centre - point, a - b, a - c])
        if abs(np.linalg.det(matrix)) < 1e-14:
            continue
        t, u, v = np.linalg.solve(matrix, a - point)
        if 1e-9 < t < 1 and u >= 0 and v >= 0 and u + v <= 1:
            return False
    return True


def normal(k: int, points: Floats, faces: NDArray[np.int64]) -> Floats:
    """Normal at a vertex: the sum of its triangles' cross products, of length one."""
    total = np.zeros(3)
    for i, j, m in faces:
        if k in (i, j, m):
            total += np.cross(points[j] - points[i], points[m] - points[i])
    return total / np.linalg.norm(total)


def cone(directions: list[Floats], weights: list[float], most: float) -> float:
    """Degrees about the weighted mean direction within which the share `most` of the weight lies."""
    mean = sum(w * d for w, d in zip(weights, directions, strict=True))
    mean = mean / np.linalg.norm(mean)
    off = sorted(
        (math.degrees(math.acos(min(1.0, max(-1.0, float(d @ mean))))), w)
        for w, d in zip(weights, directions, strict=True)
    )
    reached = 0.0
    for angle, weight in off:
        reached += weight
        if reached >= most * sum(weights) - 1e-9:
            return angle
    raise AssertionError
