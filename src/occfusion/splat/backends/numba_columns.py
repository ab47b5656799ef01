"""What both passes over the Gaussians begin with: some of them side by side, a number of each in a column.

Gaussians are handled `PART` at a time, step after step, and what a step finds lies in columns of neighbouring
numbers: loops over them are vector code, in float64, so that the only roundings left are those of the inputs and of
the stored result. The loops run to the end of the columns, whatever is left there: those of a fixed length compile
faster.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from occfusion.cpu.compilation import inline, step
from occfusion.splat.backends.numba_geometry import (
    affine_of,
    plane_from_covariance,
    plane_from_root,
    ray_of,
    rotation_of,
    symmetric_part,
    unit_quaternion,
)
from occfusion.splat.backends.numba_harmonics import BASIS_SIZE, fill_basis
from occfusion.splat.backends.numba_local import local_array
from occfusion.splat.harmonics import MAX_DEGREE

PART = BASIS_SIZE
"""Gaussians handled at a time; sums over Gaussians are formed part by part whatever the threads.

As many as there are harmonics, so that a table of these is a square.
"""

WX, WY, WZ = 0, 1, 2  # centre in the world
SHAPE = 3  # quaternion and scales as they came, or the six numbers of a covariance
X, Y, Z = 10, 11, 12  # centre in the camera's axes
ROW_X, ROW_Y = 13, 16  # rows of Jacobian times view rotation
A, B, C, FLAT = 19, 20, 21, 22  # projected covariance without dilation, and its determinant
DX, DY, DZ, NEARNESS = 23, 24, 25, 26  # unit direction from the camera, and the inverse of the distance
COLUMNS = 27

local_table = local_array((BASIS_SIZE, PART), np.float32)
local_rows = local_array((PART,), np.int64)


@step
def load(i: int, k: int, means: Any, quats: Any, scales: Any, covariances: Any, v: Any) -> None:
    """Copies centre and shape of Gaussian i to place k of the columns."""
    for j in range(3):
        v[WX + j, k] = means[i, j]
    if covariances.shape[0] > 0:
        six = symmetric_part(covariances, i)
        for j in range(6):
            v[SHAPE + j, k] = six[j]
    else:
        for j in range(4):
            v[SHAPE + j, k] = quats[i, j]
        for j in range(3):
            v[SHAPE + 4 + j, k] = scales[i, j]


@inline
def quaternion_of(v: Any, k: int) -> tuple[float, ...]:
    """Returns the quaternion of place k by `unit_quaternion`."""
    return unit_quaternion(v[SHAPE, k], v[SHAPE + 1, k], v[SHAPE + 2, k], v[SHAPE + 3, k])


@inline
def scales_of(v: Any, k: int) -> tuple[float, ...]:
    """Returns the scales of place k."""
    return v[SHAPE + 4, k], v[SHAPE + 5, k], v[SHAPE + 6, k]


@inline
def covariance_of(v: Any, k: int) -> tuple[float, ...]:
    """Returns xx, yy, zz, xy, xz, yz of the covariance of place k."""
    return v[SHAPE, k], v[SHAPE + 1, k], v[SHAPE + 2, k], v[SHAPE + 3, k], v[SHAPE + 4, k], v[SHAPE + 5, k]


@step
def see(camera: Any, v: Any) -> None:
    """Fills the columns of centre and affine rows; `camera` is by `pack_camera`."""
    for k in range(PART):
        wx, wy, wz = v[WX, k], v[WY, k], v[WZ, k]
        x = camera[0] * wx + camera[1] * wy + camera[2] * wz + camera[9]
        y = camera[3] * wx + camera[4] * wy + camera[5] * wz + camera[10]
        z = camera[6] * wx + camera[7] * wy + camera[8] * wz + camera[11]
        v[X, k], v[Y, k], v[Z, k] = x, y, z
        row_x, row_y = affine_of(camera, x, y, z)
        v[ROW_X, k], v[ROW_X + 1, k], v[ROW_X + 2, k] = row_x
        v[ROW_Y, k], v[ROW_Y + 1, k], v[ROW_Y + 2, k] = row_y


@inline
def rows_of(v: Any, k: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Returns the affine rows of a Gaussian."""
    return (v[ROW_X, k], v[ROW_X + 1, k], v[ROW_X + 2, k]), (v[ROW_Y, k], v[ROW_Y + 1, k], v[ROW_Y + 2, k])


@step
def flatten(has_covariances: bool, v: Any) -> None:
    """Fills the columns of the projected covariance."""
    if has_covariances:
        for k in range(PART):
            row_x, row_y = rows_of(v, k)
            v[A, k], v[B, k], v[C, k], v[FLAT, k] = plane_from_covariance(row_x, row_y, covariance_of(v, k))
    else:
        for k in range(PART):
            row_x, row_y = rows_of(v, k)
            w, x, y, z, _ = quaternion_of(v, k)
            sx, sy, sz = scales_of(v, k)
            v[A, k], v[B, k], v[C, k], v[FLAT, k] = plane_from_root(
                row_x, row_y, rotation_of(w, x, y, z), sx, sy, sz
            )


@step
def fill(v: Any) -> None:
    """Fills the columns with ones, for the places where no Gaussian will come."""
    numbers = v.ravel()
    for k in range(numbers.shape[0]):
        numbers[k] = 1


@step
def face(camera: Any, v: Any) -> None:
    """Fills the columns of the direction from the camera's centre."""
    for k in range(PART):
        v[DX, k], v[DY, k], v[DZ, k], v[NEARNESS, k] = ray_of(v[WX, k], v[WY, k], v[WZ, k], camera)


@step
def spread_basis(v: Any, table: Any) -> None:
    """Fills a table `[BASIS_SIZE, PART]` with the harmonics in the directions of the columns, all degrees."""
    for k in range(PART):
        fill_basis(v[DX, k], v[DY, k], v[DZ, k], MAX_DEGREE, table[:, k])


@step
def transpose(table: Any, spare: Any) -> None:
    """Transposes a square table of the harmonics in place; `spare` is as large.

    A perfect shuffle moves the highest digit of a number's place to the end; four are the digits of a row. Neighbours
    stay together, so it is vector code: a loop over rows and columns would go number by number.
    """
    one, other = table.ravel(), spare.ravel()
    for _ in range(2):
        shuffle(one, other)
        shuffle(other, one)


@inline
def shuffle(source: Any, target: Any) -> None:
    """Writes the two halves of `source`, of `BASIS_SIZE * PART` numbers, to `target` in turn."""
    half = BASIS_SIZE * PART // 2
    for i in range(half):
        target[2 * i], target[2 * i + 1] = source[i], source[half + i]
