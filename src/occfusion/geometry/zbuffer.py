"""The z-buffer of a triangle mesh: which surface each pixel sees first, and where on it.

Perspective correct: over a triangle 1/depth is linear in the picture, depth is not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from occfusion.cpu.compilation import serial

NEAR = 0.01  # metres; triangles that reach nearer are left out whole, since nothing is clipped
NO_FACE = -1
MIN_DOUBLE_AREA = 1e-12  # square pixels; thinner triangles cover no pixel centre


class ZBuffer(NamedTuple):
    """What each pixel centre sees.

    Attributes:
        depth: `[H, W]`, metres along the optical axis; infinite where there is nothing.
        face: index of the triangle, int32 `[H, W]`; -1 where there is nothing.
        barycentrics: weights of the triangle's three corners at that point of the surface,
            `[H, W, 3]`; 0 where there is nothing.
    """

    depth: NDArray[np.float32]
    face: NDArray[np.int32]
    barycentrics: NDArray[np.float32]


def rasterize_mesh(
    pixels: NDArray[np.floating],
    depths: NDArray[np.floating],
    faces: NDArray[np.integer],
    width: int,
    height: int,
) -> ZBuffer:
    """Returns the nearest surface at each pixel centre.

    A centre on an edge belongs to both triangles; of equally near surfaces the one listed first is
    taken. To see a window of a larger picture, subtract its corner from `pixels`.

    Args:
        pixels: projected vertices, `[V, 2]`, pixels (centres at +0.5).
        depths: depth of the vertices in the camera, `[V]`, metres.
        faces: triangles, `[F, 3]`.
        width: columns of the window.
        height: rows of the window.

    Raises:
        ValueError: an array has another shape, or a face names a vertex that does not exist.
    """
    points: NDArray[np.float64] = np.ascontiguousarray(pixels, dtype=np.float64)
    distances: NDArray[np.float64] = np.ascontiguousarray(depths, dtype=np.float64)
    corners: NDArray[np.int32] = np.ascontiguousarray(faces, dtype=np.int32)
    if points.ndim != 2 or points.shape[1] != 2 or distances.shape != points.shape[:1]:
        raise ValueError(f"pixels must be [V, 2] and depths [V]; got {points.shape} and {distances.shape}")
    if corners.ndim != 2 or corners.shape[1] != 3:
        raise ValueError(f"faces must be [F, 3]; got {corners.shape}")
    if corners.size and (corners.min() < 0 or corners.max() >= len(points)):
        raise ValueError(f"faces name vertices {corners.min()}..{corners.max()} of {len(points)}")
    depth = np.full((height, width), np.inf, np.float32)
    face = np.full((height, width), NO_FACE, np.int32)
    barycentrics = np.zeros((height, width, 3), np.float32)
    _fill(points, distances, corners, depth, face, barycentrics)
    return ZBuffer(depth, face, barycentrics)


@serial
def _fill(
    pixels: NDArray[np.float64],
    depths: NDArray[np.float64],
    faces: NDArray[np.int32],
    depth: NDArray[np.float32],
    face: NDArray[np.int32],
    barycentrics: NDArray[np.float32],
) -> None:
    height, width = depth.shape
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        zi, zj, zk = depths[i], depths[j], depths[k]
        if not (zi >= NEAR and zj >= NEAR and zk >= NEAR):  # also leaves out NaN
            continue
        xi, yi = pixels[i, 0], pixels[i, 1]
        xj, yj = pixels[j, 0], pixels[j, 1]
        xk, yk = pixels[k, 0], pixels[k, 1]
        area = (xj - xi) * (yk - yi) - (yj - yi) * (xk - xi)
        if not abs(area) > MIN_DOUBLE_AREA:
            continue
        # comparisons before the conversion to integers: coordinates may be huge
        left, right = max(min(xi, xj, xk) - 0.5, 0.0), min(max(xi, xj, xk) - 0.5, width - 1.0)
        top, bottom = max(min(yi, yj, yk) - 0.5, 0.0), min(max(yi, yj, yk) - 0.5, height - 1.0)
        if not (left <= right and top <= bottom):
            continue
        inverse = 1.0 / area
        ri, rj, rk = 1.0 / zi, 1.0 / zj, 1.0 / zk
        for row in range(int(np.ceil(top)), int(np.floor(bottom)) + 1):
            y = row + 0.5
            for column in range(int(np.ceil(left)), int(np.floor(right)) + 1):
                x = column + 0.5
                a = ((xj - x) * (yk - y) - (yj - y) * (xk - x)) * inverse
                b = ((xk - x) * (yi - y) - (yk - y) * (xi - x)) * inverse
                c = 1.0 - a - b
                if a < 0.0 or b < 0.0 or c < 0.0:
                    continue
                a, b, c = a * ri, b * rj, c * rk
                z = 1.0 / (a + b + c)
                if z < depth[row, column]:
                    depth[row, column] = z
                    face[row, column] = f
                    barycentrics[row, column, 0] = a * z
                    barycentrics[row, column, 1] = b * z
                    barycentrics[row, column, 2] = c * z
