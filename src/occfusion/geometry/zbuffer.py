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
FAR, FLAT, MARGIN = 1e5, 1e-3, 0.01
"""Pixels: corners farther away, and edges that rise less, do not tell in which columns a triangle lies; where others
say that it ends, up to the margin, rounding may. What is in it is decided column by column all the same."""


class Nearest(NamedTuple):
    """What each pixel centre sees first.

    Attributes:
        depth: `[H, W]`, metres along the optical axis; infinite where there is nothing.
        face: index of the triangle, int32 `[H, W]`; -1 where there is nothing.
    """

    depth: NDArray[np.float32]
    face: NDArray[np.int32]


class ZBuffer(NamedTuple):
    """What each pixel centre sees, and where on it.

    Attributes:
        depth: as in `Nearest`.
        face: as in `Nearest`.
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
    """Returns the nearest surface at each pixel centre, and where on its triangle that is.

    Arguments, errors and what is taken of equals are those of `nearest_faces`.
    """
    points, distances, corners = _checked(pixels, depths, faces)
    depth, face = _nearest(points, distances, corners, width, height, False)
    barycentrics = np.zeros((height, width, 3), np.float32)
    _fill_barycentrics(points, distances, corners, face, barycentrics)
    return ZBuffer(depth, face, barycentrics)


def nearest_faces(
    pixels: NDArray[np.floating],
    depths: NDArray[np.floating],
    faces: NDArray[np.integer],
    width: int,
    height: int,
    *,
    closed: bool = False,
) -> Nearest:
    """Returns the nearest surface at each pixel centre.

    A centre on an edge belongs to both triangles; of equally near surfaces the one listed first is
    taken. To see a window of a larger picture, subtract its corner from `pixels`.

    Args:
        pixels: projected vertices, `[V, 2]`, pixels (centres at +0.5).
        depths: depth of the vertices in the camera, `[V]`, metres.
        faces: triangles, `[F, 3]`.
        width: columns of the window.
        height: rows of the window.
        closed: the mesh is (`winding.is_closed`), and all of it lies before the camera: triangles seen from behind are
            left out, which takes half of the time. Each ray enters a closed surface before it leaves it, so that as
            much is covered. Where a pose has turned a part inside out, what lies behind that is seen.

    Raises:
        ValueError: an array has another shape, or a face names a vertex that does not exist.
    """
    return _nearest(*_checked(pixels, depths, faces), width, height, closed)


def _checked(
    pixels: NDArray[np.floating], depths: NDArray[np.floating], faces: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    points: NDArray[np.float64] = np.ascontiguousarray(pixels, dtype=np.float64)
    distances: NDArray[np.float64] = np.ascontiguousarray(depths, dtype=np.float64)
    corners: NDArray[np.int32] = np.ascontiguousarray(faces, dtype=np.int32)
    if points.ndim != 2 or points.shape[1] != 2 or distances.shape != points.shape[:1]:
        raise ValueError(f"pixels must be [V, 2] and depths [V]; got {points.shape} and {distances.shape}")
    if corners.ndim != 2 or corners.shape[1] != 3:
        raise ValueError(f"faces must be [F, 3]; got {corners.shape}")
    if corners.size and (corners.min() < 0 or corners.max() >= len(points)):
        raise ValueError(f"faces name vertices {corners.min()}..{corners.max()} of {len(points)}")
    return points, distances, corners


def _nearest(
    points: NDArray[np.float64],
    distances: NDArray[np.float64],
    corners: NDArray[np.int32],
    width: int,
    height: int,
    closed: bool,
) -> Nearest:
    depth = np.full((height, width), np.inf, np.float32)
    face = np.full((height, width), NO_FACE, np.int32)
    # a mesh that reaches to the camera is cut open there
    _fill(points, distances, corners, closed and bool((distances >= NEAR).all()), depth, face)
    return Nearest(depth, face)


@serial
def _fill(
    pixels: NDArray[np.float64],
    depths: NDArray[np.float64],
    faces: NDArray[np.int32],
    closed: bool,
    depth: NDArray[np.float32],
    face: NDArray[np.int32],
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
        # from the front, corners run counter-clockwise, which y downwards makes negative
        if closed and area > 0.0:
            continue
        # comparisons before the conversion to integers: coordinates may be huge
        left, right = max(min(xi, xj, xk) - 0.5, 0.0), min(max(xi, xj, xk) - 0.5, width - 1.0)
        top, bottom = max(min(yi, yj, yk) - 0.5, 0.0), min(max(yi, yj, yk) - 0.5, height - 1.0)
        if not (left <= right and top <= bottom):
            continue
        inverse = 1.0 / area
        ri, rj, rk = 1.0 / zi, 1.0 / zj, 1.0 / zk
        first, last = int(np.ceil(left)), int(np.floor(right))
        # by how much the weights of the three corners fall from column to column, where that tells where they are 0
        is_far = not (max(abs(xi), abs(xj), abs(xk), abs(yi), abs(yj), abs(yk)) < FAR)
        fall_a = 0.0 if is_far or abs(yk - yj) < FLAT else (yk - yj) * inverse
        fall_b = 0.0 if is_far or abs(yi - yk) < FLAT else (yi - yk) * inverse
        fall_c = 0.0 if is_far or abs(yj - yi) < FLAT else (yj - yi) * inverse
        steep_a = 1.0 / fall_a if fall_a != 0.0 else 0.0
        steep_b = 1.0 / fall_b if fall_b != 0.0 else 0.0
        steep_c = 1.0 / fall_c if fall_c != 0.0 else 0.0
        for row in range(int(np.ceil(top)), int(np.floor(bottom)) + 1):
            y, x = row + 0.5, first + 0.5
            a = ((xj - x) * (yk - y) - (yj - y) * (xk - x)) * inverse
            b = ((xk - x) * (yi - y) - (yk - y) * (xi - x)) * inverse
            c = 1.0 - a - b
            begin, end = 0.0, float(last - first)
            if fall_a > 0.0:
                end = min(end, a * steep_a)
            elif fall_a < 0.0:
                begin = max(begin, a * steep_a)
            if fall_b > 0.0:
                end = min(end, b * steep_b)
            elif fall_b < 0.0:
                begin = max(begin, b * steep_b)
            if fall_c > 0.0:
                end = min(end, c * steep_c)
            elif fall_c < 0.0:
                begin = max(begin, c * steep_c)
            for column in range(first + int(begin + 1.0 - MARGIN), first + int(np.floor(end + MARGIN)) + 1):
                x = column + 0.5
                a = ((xj - x) * (yk - y) - (yj - y) * (xk - x)) * inverse
                b = ((xk - x) * (yi - y) - (yk - y) * (xi - x)) * inverse
                c = 1.0 - a - b
                if a < 0.0 or b < 0.0 or c < 0.0:
                    continue
                z = 1.0 / (a * ri + b * rj + c * rk)
                if z < depth[row, column]:
                    depth[row, column] = z
                    face[row, column] = f


@serial
def _fill_barycentrics(
    pixels: NDArray[np.float64],
    depths: NDArray[np.float64],
    faces: NDArray[np.int32],
    face: NDArray[np.int32],
    barycentrics: NDArray[np.float32],
) -> None:
    height, width = face.shape
    for row in range(height):
        y = row + 0.5
        for column in range(width):
            f = face[row, column]
            if f == NO_FACE:
                continue
            x = column + 0.5
            i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
            xi, yi = pixels[i, 0], pixels[i, 1]
            xj, yj = pixels[j, 0], pixels[j, 1]
            xk, yk = pixels[k, 0], pixels[k, 1]
            inverse = 1.0 / ((xj - xi) * (yk - yi) - (yj - yi) * (xk - xi))
            a = ((xj - x) * (yk - y) - (yj - y) * (xk - x)) * inverse
            b = ((xk - x) * (yi - y) - (yk - y) * (xi - x)) * inverse
            c = 1.0 - a - b
            a, b, c = a / depths[i], b / depths[j], c / depths[k]
            z = 1.0 / (a + b + c)
            barycentrics[row, column, 0] = a * z
            barycentrics[row, column, 1] = b * z
            barycentrics[row, column, 2] = c * z
