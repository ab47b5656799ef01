"""Projection and colour of each Gaussian, fused (the formulas are those of `splat.projection`).

The geometry is done in float64: for scalar code that costs nothing, and the only roundings left are
those of the inputs and of the stored result.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from occfusion.splat.backends.numba_compile import inline, kernel
from occfusion.splat.backends.numba_harmonics import fill_basis
from occfusion.splat.backends.numba_layout import (
    BLUE,
    DEPTH,
    EXP_SHIFT,
    GREEN,
    HALF_HEIGHT,
    INVERSE_L1,
    L1,
    L2,
    LOG_OPACITY,
    REACH,
    RED,
    TURN,
    X_PART,
    X_WHOLE,
    Y_PART,
    Y_WHOLE,
    M,
)
from occfusion.splat.limits import COMPENSATION_FLOOR, QUATERNION_FLOOR

PART = 256
"""Gaussians handled at a time; sums over Gaussians are formed part by part whatever the threads."""


@inline
def unit_quaternion(quats: Any, i: int) -> tuple[float, float, float, float, float]:
    """Returns w, x, y, z of length 1 and the inverse of the length it had; 0 for no rotation."""
    w, x, y, z = (
        np.float64(quats[i, 0]),
        np.float64(quats[i, 1]),
        np.float64(quats[i, 2]),
        np.float64(quats[i, 3]),
    )
    if max(abs(w), abs(x), abs(y), abs(z)) < QUATERNION_FLOOR:
        return 1.0, 0.0, 0.0, 0.0, 0.0
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@inline
def rotation_of(w: float, x: float, y: float, z: float) -> tuple[float, ...]:
    """Returns the matrix of a unit quaternion, 9 numbers row by row."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@inline
def affine_of(camera: Any, x: float, y: float, z: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Returns the two rows of Jacobian times view rotation; `camera` is by `pack_camera`."""
    inverse_z = 1 / z
    slope_x = min(max(x * inverse_z, camera[16]), camera[17])
    slope_y = min(max(y * inverse_z, camera[18]), camera[19])
    kx, ky = camera[12] * inverse_z, camera[13] * inverse_z
    row_x = (
        kx * (camera[0] - slope_x * camera[6]),
        kx * (camera[1] - slope_x * camera[7]),
        kx * (camera[2] - slope_x * camera[8]),
    )
    row_y = (
        ky * (camera[3] - slope_y * camera[6]),
        ky * (camera[4] - slope_y * camera[7]),
        ky * (camera[5] - slope_y * camera[8]),
    )
    return row_x, row_y


@inline
def dot(p: tuple[float, ...], q0: float, q1: float, q2: float) -> float:
    """Returns the product of two vectors."""
    return p[0] * q0 + p[1] * q1 + p[2] * q2


@inline
def plane_from_root(
    row_x: tuple[float, ...],
    row_y: tuple[float, ...],
    rotation: tuple[float, ...],
    sx: float,
    sy: float,
    sz: float,
) -> tuple[float, float, float, float]:
    """Returns a, b, c and the determinant of the projected covariance; its square root is rotation times scales."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
    rx0, ry0 = dot(row_x, r00, r10, r20) * sx, dot(row_y, r00, r10, r20) * sx
    rx1, ry1 = dot(row_x, r01, r11, r21) * sy, dot(row_y, r01, r11, r21) * sy
    rx2, ry2 = dot(row_x, r02, r12, r22) * sz, dot(row_y, r02, r12, r22) * sz
    c0, c1, c2 = rx1 * ry2 - rx2 * ry1, rx2 * ry0 - rx0 * ry2, rx0 * ry1 - rx1 * ry0
    a, b = rx0 * rx0 + rx1 * rx1 + rx2 * rx2, rx0 * ry0 + rx1 * ry1 + rx2 * ry2
    return a, b, ry0 * ry0 + ry1 * ry1 + ry2 * ry2, c0 * c0 + c1 * c1 + c2 * c2


@inline
def symmetric_part(cov: Any, i: int) -> tuple[float, ...]:
    """Returns xx, yy, zz, xy, xz, yz of a covariance's symmetric part."""
    return (
        np.float64(cov[i, 0, 0]), np.float64(cov[i, 1, 1]), np.float64(cov[i, 2, 2]),
        0.5 * (np.float64(cov[i, 0, 1]) + np.float64(cov[i, 1, 0])),
        0.5 * (np.float64(cov[i, 0, 2]) + np.float64(cov[i, 2, 0])),
        0.5 * (np.float64(cov[i, 1, 2]) + np.float64(cov[i, 2, 1])),
    )  # fmt: skip


@inline
def plane_from_covariance(
    row_x: tuple[float, ...], row_y: tuple[float, ...], cov: Any, i: int
) -> tuple[float, float, float, float]:
    """Returns a, b, c and the determinant of the projected covariance; the symmetric part is used."""
    xx, yy, zz, xy, xz, yz = symmetric_part(cov, i)
    sq0, sq1, sq2 = dot(row_y, xx, xy, xz), dot(row_y, xy, yy, yz), dot(row_y, xz, yz, zz)
    a = max(dot(row_x, dot(row_x, xx, xy, xz), dot(row_x, xy, yy, yz), dot(row_x, xz, yz, zz)), 0.0)
    b = dot(row_x, sq0, sq1, sq2)
    c = max(dot(row_y, sq0, sq1, sq2), 0.0)
    return a, b, c, max(a * c - b * b, 0.0)


@kernel
def project_part(
    means: Any, quats: Any, scales: Any, covariances: Any, opacities: Any, colors: Any, offsets: Any,
    camera: Any, window: Any, options: Any, degree: int, splats: Any, radii: Any, all_basis: Any,
    part: int, parts: int,
) -> None:  # fmt: skip
    """Writes a row of `splats` `[N, 16]` and of `radii` for each visible Gaussian; REACH is 0 for the others.

    Absent inputs have no rows; `colors` are `[N, 3 K]`. `window` is the range of pixel centres wanted (x0, x1, y0, y1);
    `options` is (near, dilation, alpha_min, antialiased); `degree` is -1 for plain colours;
    `all_basis` is working space.
    """
    n = means.shape[0]
    near, dilation, alpha_min, antialiased = options[0], options[1], options[2], options[3] != 0
    log_alpha_min = math.log(alpha_min)
    basis = all_basis[part]
    bands = (degree + 1) * (degree + 1)
    for begin in range(part * PART, n, parts * PART):
        for i in range(begin, min(n, begin + PART)):
            splat = splats[i]
            splat[REACH] = 0
            wx, wy, wz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            z = camera[6] * wx + camera[7] * wy + camera[8] * wz + camera[11]
            opacity = np.float64(opacities[i])
            if not (z > near) or not (opacity > alpha_min):
                continue
            x = camera[0] * wx + camera[1] * wy + camera[2] * wz + camera[9]
            y = camera[3] * wx + camera[4] * wy + camera[5] * wz + camera[10]
            inverse_z = 1 / z
            mx, my = camera[12] * x * inverse_z + camera[14], camera[13] * y * inverse_z + camera[15]
            if offsets.shape[0] > 0:
                mx += offsets[i, 0]
                my += offsets[i, 1]
            row_x, row_y = affine_of(camera, x, y, z)
            if covariances.shape[0] > 0:
                a, b, c, flat = plane_from_covariance(row_x, row_y, covariances, i)
            else:
                qw, qx, qy, qz, _ = unit_quaternion(quats, i)
                sx, sy, sz = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
                a, b, c, flat = plane_from_root(row_x, row_y, rotation_of(qw, qx, qy, qz), sx, sy, sz)
            det = flat + dilation * (a + c) + dilation * dilation
            a += dilation
            c += dilation
            if antialiased:
                opacity *= math.sqrt(max(flat / det, COMPENSATION_FLOOR))
                if not (opacity > alpha_min):
                    continue
            log_opacity = math.log(opacity)
            reach = 2 * (log_opacity - log_alpha_min)
            root_a, root_c, root_det, root_reach = (
                math.sqrt(a),
                math.sqrt(c),
                math.sqrt(det),
                math.sqrt(reach),
            )
            rx, ry = root_reach * root_a, root_reach * root_c
            if mx + rx < window[0] or mx - rx > window[1] or my + ry < window[2] or my - ry > window[3]:
                continue
            radii[i, 0] = rx
            radii[i, 1] = ry
            splat[X_WHOLE] = np.floor(mx)
            splat[X_PART] = mx - np.floor(mx)
            splat[Y_WHOLE] = np.floor(my)
            splat[Y_PART] = my - np.floor(my)
            # one division for both: in float64 they cost most of all here, and rounding is no matter
            inverse = 1 / (root_c * root_det)
            inverse_c, inverse_det = root_det * inverse, root_c * inverse
            splat[L1] = root_c * inverse_det
            splat[M] = -b * inverse
            splat[L2] = inverse_c
            splat[LOG_OPACITY] = log_opacity + EXP_SHIFT
            splat[DEPTH] = z
            splat[REACH] = reach
            splat[HALF_HEIGHT] = ry
            splat[TURN] = b * root_reach / root_a
            splat[INVERSE_L1] = root_det * inverse_c
            if degree < 0:
                splat[RED] = colors[i, 0]
                splat[GREEN] = colors[i, 1]
                splat[BLUE] = colors[i, 2]
                continue
            dx, dy, dz = wx - camera[20], wy - camera[21], wz - camera[22]
            inverse = 1 / math.sqrt(dx * dx + dy * dy + dz * dz)
            fill_basis(dx * inverse, dy * inverse, dz * inverse, degree, basis)
            red = green = blue = np.float32(0.5)
            row = colors[i]
            for k in range(bands):
                red += basis[k] * row[3 * k]
                green += basis[k] * row[3 * k + 1]
                blue += basis[k] * row[3 * k + 2]
            splat[RED] = max(red, np.float32(0))
            splat[GREEN] = max(green, np.float32(0))
            splat[BLUE] = max(blue, np.float32(0))
