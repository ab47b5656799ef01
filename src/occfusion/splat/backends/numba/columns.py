"""What both passes over the Gaussians begin with: some of them side by side, a number of each in a column.

Gaussians are handled `PART` at a time, step after step, and what a step finds lies in columns of neighbouring
numbers: loops over them are vector code, in float64, so that the only roundings left are those of the inputs and of
the stored result. The loops run to the end of the columns, whatever is left there: those of a fixed length compile
faster.

Then come the steps back, from gradients on the picture to those of the same Gaussians.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from occfusion.cpu.compilation import inline, step
from occfusion.splat.backends.numba.geometry import (
    BASIS_SIZE,
    affine_of,
    covariance_gradient,
    direction_gradient,
    dot,
    factor_gradient,
    fill_basis,
    plane_from_covariance,
    plane_from_root,
    ray_of,
    root_gradient,
    rotation_of,
    symmetric_part,
    unit_quaternion,
)
from occfusion.splat.backends.numba.layout import BLUE, GREEN, RED, local_array
from occfusion.splat.harmonics import MAX_DEGREE
from occfusion.splat.limits import COMPENSATION_FLOOR

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
def load_centre(i: int, k: int, means: Any, v: Any) -> None:
    """Copies the centre of Gaussian i to place k of the columns."""
    for j in range(3):
        v[WX + j, k] = means[i, j]


@step
def load_covariance(i: int, k: int, covariances: Any, v: Any) -> None:
    """Copies the shape of Gaussian i to place k of the columns, where it is a covariance."""
    six = symmetric_part(covariances, i)
    for j in range(6):
        v[SHAPE + j, k] = six[j]


@step
def load_root(i: int, k: int, quats: Any, scales: Any, v: Any) -> None:
    """Copies the shape of Gaussian i to place k of the columns, where it is a quaternion and scales."""
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
def flatten_covariance(v: Any) -> None:
    """Fills the columns of the projected covariance, where shapes are covariances."""
    for k in range(PART):
        row_x, row_y = rows_of(v, k)
        v[A, k], v[B, k], v[C, k], v[FLAT, k] = plane_from_covariance(row_x, row_y, covariance_of(v, k))


@step
def flatten_root(v: Any) -> None:
    """Fills the columns of the projected covariance, where shapes are quaternions and scales."""
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
    for j in range(v.shape[0]):
        for k in range(PART):
            v[j, k] = 1


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
    for _ in range(2):
        shuffle(table, spare)
        shuffle(spare, table)


@inline
def shuffle(source: Any, target: Any) -> None:
    """Writes the numbers of the two halves of `source`, row after row, to `target` in turn; both are square."""
    half = BASIS_SIZE // 2
    for j in range(half):
        near, far, even, odd = source[j], source[half + j], target[2 * j], target[2 * j + 1]
        for k in range(half):
            even[2 * k], even[2 * k + 1] = near[k], far[k]
            odd[2 * k], odd[2 * k + 1] = near[half + k], far[half + k]


# Columns that only this pass has: the sums over pairs in their order, the splat's factor, and gradients.
P_U, P_V, P_UU, P_UV, P_VV, P_POWER, P_COLOR, P_FAR = *range(COLUMNS, COLUMNS + 7), COLUMNS + 9
V_L1, V_M, V_L2 = range(COLUMNS + 10, COLUMNS + 13)
G_W = COLUMNS + 13  # of the centre by way of the colour
G_MX, G_MY = COLUMNS + 16, COLUMNS + 17
G_A, G_B, G_C = range(COLUMNS + 18, COLUMNS + 21)
G_ROW_X, G_ROW_Y = COLUMNS + 21, COLUMNS + 24
G_SHAPE = COLUMNS + 27
G_X, G_Y, G_Z = range(COLUMNS + 34, COLUMNS + 37)  # of the centre in the camera's axes
COLUMNS_BACKWARD = COLUMNS + 37


@step
def clamp_colors(rows: Any, count: int, splats: Any, v: Any) -> None:
    """Clears the gradient of a colour that was clamped at zero, as those of harmonics are."""
    for k in range(count):
        splat = splats[rows[k]]
        v[P_COLOR, k] = v[P_COLOR, k] if splat[RED] > 0 else 0.0
        v[P_COLOR + 1, k] = v[P_COLOR + 1, k] if splat[GREEN] > 0 else 0.0
        v[P_COLOR + 2, k] = v[P_COLOR + 2, k] if splat[BLUE] > 0 else 0.0


@step
def write_colors(rows: Any, count: int, bands: int, basis: Any, spare: Any, v: Any, g_colors: Any) -> None:
    """Writes the gradient of the harmonics' coefficients; `basis` and `spare` are working space."""
    spread_basis(v, basis)
    transpose(basis, spare)
    for k in range(count):
        red, green, blue = (
            np.float32(v[P_COLOR, k]),
            np.float32(v[P_COLOR + 1, k]),
            np.float32(v[P_COLOR + 2, k]),
        )
        row, values = g_colors[rows[k]], basis[k]
        for j in range(bands):
            row[3 * j], row[3 * j + 1], row[3 * j + 2] = values[j] * red, values[j] * green, values[j] * blue
        for j in range(3 * bands, g_colors.shape[1]):
            row[j] = 0


@step
def unface(rows: Any, count: int, bands: int, colors: Any, g_basis: Any, spare: Any, v: Any) -> None:
    """Fills the columns of what the centre gets by way of the colour; `g_basis` and `spare` are working space."""
    for k in range(count):
        red, green, blue = (
            np.float32(v[P_COLOR, k]),
            np.float32(v[P_COLOR + 1, k]),
            np.float32(v[P_COLOR + 2, k]),
        )
        row, values = colors[rows[k]], g_basis[k]
        for j in range(bands):
            values[j] = row[3 * j] * red + row[3 * j + 1] * green + row[3 * j + 2] * blue
        for j in range(bands, BASIS_SIZE):
            values[j] = 0
    transpose(g_basis, spare)
    for k in range(PART):
        dx, dy, dz, nearness = v[DX, k], v[DY, k], v[DZ, k], v[NEARNESS, k]
        gx, gy, gz = direction_gradient(dx, dy, dz, MAX_DEGREE, g_basis[:, k])
        along = gx * dx + gy * dy + gz * dz
        v[G_W, k] = (gx - along * dx) * nearness
        v[G_W + 1, k] = (gy - along * dy) * nearness
        v[G_W + 2, k] = (gz - along * dz) * nearness


@step
def unfactorize(dilation: float, antialiased: bool, v: Any) -> None:
    """Fills the columns of the gradient of the projected covariance."""
    for k in range(PART):
        a0, b, c0 = v[A, k], v[B, k], v[C, k]
        det = v[FLAT, k] + dilation * (a0 + c0) + dilation * dilation
        v[G_A, k], v[G_B, k], v[G_C, k] = factor_gradient(
            a0 + dilation,
            b,
            c0 + dilation,
            det,
            v[P_UU, k],
            v[P_UV, k],
            v[P_VV, k],
        )
    if antialiased:
        for k in range(PART):
            a0, b, c0, flat = v[A, k], v[B, k], v[C, k], v[FLAT, k]
            a, c = a0 + dilation, c0 + dilation
            det = flat + dilation * (a0 + c0) + dilation * dilation
            ratio = flat / det
            # gradient of log opacity is G_POWER; log mass = log(flat / det) / 2
            g_ratio = 0.5 * v[P_POWER, k] / ratio if ratio > COMPENSATION_FLOOR else 0.0
            v[G_A, k] += g_ratio * (c0 - ratio * c) / det
            v[G_B, k] -= 2 * g_ratio * (1 - ratio) * b / det
            v[G_C, k] += g_ratio * (a0 - ratio * a) / det


@step
def unflatten_covariance(v: Any) -> None:
    """Fills the columns of the gradients of shape and affine rows, where shapes are covariances."""
    for k in range(PART):
        row_x, row_y = rows_of(v, k)
        g_cov, g_row_x, g_row_y = covariance_gradient(
            row_x, row_y, covariance_of(v, k), v[G_A, k], v[G_B, k], v[G_C, k]
        )
        for j in range(6):
            v[G_SHAPE + j, k] = g_cov[j]
        for j in range(3):
            v[G_ROW_X + j, k], v[G_ROW_Y + j, k] = g_row_x[j], g_row_y[j]


@step
def unflatten_root(v: Any) -> None:
    """Fills the columns of the gradients of shape and affine rows, where shapes are quaternions and scales."""
    for k in range(PART):
        row_x, row_y = rows_of(v, k)
        g_quats, g_scales, g_row_x, g_row_y = root_gradient(
            row_x, row_y, quaternion_of(v, k), scales_of(v, k), v[G_A, k], v[G_B, k], v[G_C, k]
        )
        for j in range(4):
            v[G_SHAPE + j, k] = g_quats[j]
        for j in range(3):
            v[G_SHAPE + 4 + j, k] = g_scales[j]
            v[G_ROW_X + j, k], v[G_ROW_Y + j, k] = g_row_x[j], g_row_y[j]


@step
def write_symmetric(v: Any, k: int, out: Any) -> None:
    """Writes the gradient of place k's covariance to `out` `[3, 3]`."""
    out[0, 0], out[1, 1], out[2, 2] = v[G_SHAPE, k], v[G_SHAPE + 1, k], v[G_SHAPE + 2, k]
    out[0, 1] = out[1, 0] = v[G_SHAPE + 3, k]
    out[0, 2] = out[2, 0] = v[G_SHAPE + 4, k]
    out[1, 2] = out[2, 1] = v[G_SHAPE + 5, k]


@step
def unsee(camera: Any, v: Any) -> None:
    """Fills the columns of the gradient of the centre in the camera's axes."""
    for k in range(PART):
        x, y, inverse_z = v[X, k], v[Y, k], 1 / v[Z, k]
        row_x, row_y = rows_of(v, k)
        g_row_x = v[G_ROW_X, k], v[G_ROW_X + 1, k], v[G_ROW_X + 2, k]
        g_row_y = v[G_ROW_Y, k], v[G_ROW_Y + 1, k], v[G_ROW_Y + 2, k]
        kx, ky = camera[12] * inverse_z, camera[13] * inverse_z
        free_x, free_y = x * inverse_z, y * inverse_z
        g_x, g_y = v[G_MX, k] * kx, v[G_MY, k] * ky
        # what is multiplied by 1 / z: the centre's distance from the axis, and the affine rows
        g_log_z = -(g_x * x + g_y * y) - dot(g_row_x, row_x[0], row_x[1], row_x[2])
        g_log_z -= dot(g_row_y, row_y[0], row_y[1], row_y[2])
        # a slope that was clamped does not follow the centre
        is_free_x = free_x >= camera[16] and free_x <= camera[17]
        is_free_y = free_y >= camera[18] and free_y <= camera[19]
        g_slope_x = -kx * dot(g_row_x, camera[6], camera[7], camera[8]) if is_free_x else 0.0
        g_slope_y = -ky * dot(g_row_y, camera[6], camera[7], camera[8]) if is_free_y else 0.0
        g_x += g_slope_x * inverse_z
        g_y += g_slope_y * inverse_z
        g_log_z -= g_slope_x * free_x + g_slope_y * free_y
        v[G_X, k], v[G_Y, k], v[G_Z, k] = g_x, g_y, v[P_FAR, k] + g_log_z * inverse_z


@step
def add_to_camera(count: int, camera: Any, v: Any, g_rows: Any) -> None:
    """Adds the gradient of rotation (9) and translation (3), of the Gaussians one after another, to `g_rows`."""
    for k in range(count):
        inverse_z = 1 / v[Z, k]
        kx, ky = camera[12] * inverse_z, camera[13] * inverse_z
        slope_x = np.minimum(np.maximum(v[X, k] * inverse_z, camera[16]), camera[17])
        slope_y = np.minimum(np.maximum(v[Y, k] * inverse_z, camera[18]), camera[19])
        g_x, g_y, g_z = v[G_X, k], v[G_Y, k], v[G_Z, k]
        for j in range(3):
            w, g_row_x, g_row_y = v[WX + j, k], kx * v[G_ROW_X + j, k], ky * v[G_ROW_Y + j, k]
            # the affine rows, then the centre, then the ray, which is mean + rotation^T translation
            g_rows[j] += g_row_x + g_x * w + camera[9] * v[G_W + j, k]
            g_rows[3 + j] += g_row_y + g_y * w + camera[10] * v[G_W + j, k]
            g_rows[6 + j] += g_z * w + camera[11] * v[G_W + j, k] - (slope_x * g_row_x + slope_y * g_row_y)
            g_rows[9 + j] += v[G_X + j, k]
            for axis in range(3):
                g_rows[9 + j] += camera[3 * j + axis] * v[G_W + axis, k]
