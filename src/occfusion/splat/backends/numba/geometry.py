"""One Gaussian's projection, harmonics and their gradients, in float64.

The formulas are those of `splat.projection` and `splat.harmonics`. No branches in the projection: the loops that use
it become vector code.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from occfusion.cpu.compilation import inline
from occfusion.splat.harmonics import (
    SH_C0,
    SH_C1,
    SH_C2_XX,
    SH_C2_XY,
    SH_C2_ZZ,
    SH_C3_0,
    SH_C3_1,
    SH_C3_2,
    SH_C3_3,
)
from occfusion.splat.limits import QUATERNION_FLOOR


@inline
def unit_quaternion(w: float, x: float, y: float, z: float) -> tuple[float, float, float, float, float]:
    """Returns w, x, y, z of length 1 and the inverse of the length it had; 0 for no rotation."""
    is_none = np.maximum(np.maximum(abs(w), abs(x)), np.maximum(abs(y), abs(z))) < QUATERNION_FLOOR
    inverse = 1.0 / math.sqrt(1.0 if is_none else w * w + x * x + y * y + z * z)
    inverse = 0.0 if is_none else inverse
    return (1.0 if is_none else w * inverse), x * inverse, y * inverse, z * inverse, inverse


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
    slope_x = np.minimum(np.maximum(x * inverse_z, camera[16]), camera[17])
    slope_y = np.minimum(np.maximum(y * inverse_z, camera[18]), camera[19])
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
    row_x: tuple[float, ...], row_y: tuple[float, ...], cov: tuple[float, ...]
) -> tuple[float, float, float, float]:
    """Returns a, b, c and the determinant of the projected covariance; `cov` is by `symmetric_part`."""
    xx, yy, zz, xy, xz, yz = cov
    sq0, sq1, sq2 = dot(row_y, xx, xy, xz), dot(row_y, xy, yy, yz), dot(row_y, xz, yz, zz)
    a = np.maximum(dot(row_x, dot(row_x, xx, xy, xz), dot(row_x, xy, yy, yz), dot(row_x, xz, yz, zz)), 0.0)
    b = dot(row_x, sq0, sq1, sq2)
    c = np.maximum(dot(row_y, sq0, sq1, sq2), 0.0)
    return a, b, c, np.maximum(a * c - b * b, 0.0)


@inline
def ray_of(x: float, y: float, z: float, camera: Any) -> tuple[float, float, float, float]:
    """Returns the unit direction from the camera centre to a point, and the inverse of their distance."""
    dx, dy, dz = x - camera[20], y - camera[21], z - camera[22]
    inverse = 1 / math.sqrt(dx * dx + dy * dy + dz * dz)
    return dx * inverse, dy * inverse, dz * inverse, inverse


@inline
def factor_gradient(
    a: float, b: float, c: float, det: float, uu: float, uv: float, vv: float
) -> tuple[float, float, float]:
    """Returns the gradient of the dilated covariance entries a, b, c; det = a c - b^2.

    (uu, uv, vv) are the sums over pixels of u u, u v and v v, times the gradient of the exponent -(u u + v v) / 2. With
    (u, v) = L d, L = [[l1, m], [0, l2]], the exponent's derivative is half of w^T dS w with w = L^T (u, v). Moments of
    the offsets d would cancel along a needle; those of (u, v), which are about 1, do not.
    """
    cross = uv / math.sqrt(det)
    g_b = cross - b * uu / det
    return 0.5 * c * uu / det, g_b, 0.5 * (b * b * uu / det + vv) / c - b * cross / c


@inline
def axis_gradient(
    row_x: tuple[float, ...], row_y: tuple[float, ...], r0: float, r1: float, r2: float, size: float,
    g_a: float, g_b: float, g_c: float,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Returns the gradient of the projected axis of a Gaussian (x, y), and of the axis times its size in space.

    (r0, r1, r2) is the axis, a column of the rotation. With p = size * row_x . axis and q = size * row_y . axis
    the axis adds p^2, p q, q^2 to the covariance's entries a, b, c.
    """
    p, q = dot(row_x, r0, r1, r2) * size, dot(row_y, r0, r1, r2) * size
    g_p, g_q = 2 * g_a * p + g_b * q, 2 * g_c * q + g_b * p
    return (
        g_p, g_q,
        row_x[0] * g_p + row_y[0] * g_q, row_x[1] * g_p + row_y[1] * g_q, row_x[2] * g_p + row_y[2] * g_q,
    )  # fmt: skip


@inline
def root_gradient(
    row_x: tuple[float, ...], row_y: tuple[float, ...], quaternion: tuple[float, ...],
    scales: tuple[float, ...], g_a: float, g_b: float, g_c: float,
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], tuple[float, ...]]:  # fmt: skip
    """Returns the gradients of quaternion, scales and the two affine rows, the covariance being rotation and scales'.

    `quaternion` is by `unit_quaternion`.
    """
    w, x, y, z, inverse = quaternion
    sx, sy, sz = scales
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_of(w, x, y, z)
    px, qx, x0, x1, x2 = axis_gradient(row_x, row_y, r00, r10, r20, sx, g_a, g_b, g_c)
    py, qy, y0, y1, y2 = axis_gradient(row_x, row_y, r01, r11, r21, sy, g_a, g_b, g_c)
    pz, qz, z0, z1, z2 = axis_gradient(row_x, row_y, r02, r12, r22, sz, g_a, g_b, g_c)
    g_scales = (
        x0 * r00 + x1 * r10 + x2 * r20,
        y0 * r01 + y1 * r11 + y2 * r21,
        z0 * r02 + z1 * r12 + z2 * r22,
    )
    x0, x1, x2, y0, y1, y2, z0, z1, z2 = (
        x0 * sx, x1 * sx, x2 * sx, y0 * sy, y1 * sy, y2 * sy, z0 * sz, z1 * sz, z2 * sz,
    )  # fmt: skip
    gw = 2 * (z * (x1 - y0) + y * (z0 - x2) + x * (y2 - z1))
    gx = 2 * (y * (y0 + x1) + z * (z0 + x2) + w * (y2 - z1) - 2 * x * (y1 + z2))
    gy = 2 * (x * (y0 + x1) + z * (z1 + y2) + w * (z0 - x2) - 2 * y * (x0 + z2))
    gz = 2 * (x * (z0 + x2) + y * (z1 + y2) + w * (x1 - y0) - 2 * z * (x0 + y1))
    along = w * gw + x * gx + y * gy + z * gz
    g_quats = (
        (gw - w * along) * inverse, (gx - x * along) * inverse,
        (gy - y * along) * inverse, (gz - z * along) * inverse,
    )  # fmt: skip
    px, py, pz, qx, qy, qz = px * sx, py * sy, pz * sz, qx * sx, qy * sy, qz * sz
    g_row_x = (r00 * px + r01 * py + r02 * pz, r10 * px + r11 * py + r12 * pz, r20 * px + r21 * py + r22 * pz)
    g_row_y = (r00 * qx + r01 * qy + r02 * qz, r10 * qx + r11 * qy + r12 * qz, r20 * qx + r21 * qy + r22 * qz)
    return g_quats, g_scales, g_row_x, g_row_y


@inline
def covariance_gradient(
    row_x: tuple[float, ...],
    row_y: tuple[float, ...],
    cov: tuple[float, ...],
    g_a: float,
    g_b: float,
    g_c: float,
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Returns the gradients of the covariance (xx, yy, zz, xy, xz, yz of a symmetric matrix) and the affine rows."""
    xx, yy, zz, xy, xz, yz = cov
    p0, p1, p2 = dot(row_x, xx, xy, xz), dot(row_x, xy, yy, yz), dot(row_x, xz, yz, zz)
    q0, q1, q2 = dot(row_y, xx, xy, xz), dot(row_y, xy, yy, yz), dot(row_y, xz, yz, zz)
    x0, x1, x2 = row_x
    y0, y1, y2 = row_y
    half = 0.5 * g_b
    g_cov = (
        g_a * x0 * x0 + g_b * x0 * y0 + g_c * y0 * y0,
        g_a * x1 * x1 + g_b * x1 * y1 + g_c * y1 * y1,
        g_a * x2 * x2 + g_b * x2 * y2 + g_c * y2 * y2,
        g_a * x0 * x1 + half * (x0 * y1 + x1 * y0) + g_c * y0 * y1,
        g_a * x0 * x2 + half * (x0 * y2 + x2 * y0) + g_c * y0 * y2,
        g_a * x1 * x2 + half * (x1 * y2 + x2 * y1) + g_c * y1 * y2,
    )
    g_row_x = 2 * g_a * p0 + g_b * q0, 2 * g_a * p1 + g_b * q1, 2 * g_a * p2 + g_b * q2
    g_row_y = 2 * g_c * q0 + g_b * p0, 2 * g_c * q1 + g_b * p1, 2 * g_c * q2 + g_b * p2
    return g_cov, g_row_x, g_row_y


BASIS_SIZE = 16
"""Functions of the highest degree and all below it."""


@inline
def fill_basis(x: float, y: float, z: float, degree: int, out: Any) -> None:
    """Writes the `(degree + 1)**2` basis functions at the unit direction (x, y, z) to `out`."""
    out[0] = SH_C0
    if degree >= 1:
        out[1] = -SH_C1 * y
        out[2] = SH_C1 * z
        out[3] = -SH_C1 * x
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        out[4] = SH_C2_XY * x * y
        out[5] = -SH_C2_XY * y * z
        out[6] = SH_C2_ZZ * (2 * zz - xx - yy)
        out[7] = -SH_C2_XY * x * z
        out[8] = SH_C2_XX * (xx - yy)
        if degree >= 3:
            out[9] = -SH_C3_3 * y * (3 * xx - yy)
            out[10] = SH_C3_2 * x * y * z
            out[11] = -SH_C3_1 * y * (4 * zz - xx - yy)
            out[12] = SH_C3_0 * z * (2 * zz - 3 * xx - 3 * yy)
            out[13] = -SH_C3_1 * x * (4 * zz - xx - yy)
            out[14] = 0.5 * SH_C3_2 * z * (xx - yy)
            out[15] = -SH_C3_3 * x * (xx - 3 * yy)


@inline
def direction_gradient(x: float, y: float, z: float, degree: int, g: Any) -> tuple[float, float, float]:
    """Returns the gradient with respect to (x, y, z), given `g[k]`, that of basis function k."""
    gx = gy = gz = 0.0
    # each is fetched once: a fetch costs more time to compile than what is done with it
    if degree >= 1:
        gx -= SH_C1 * g[3]
        gy -= SH_C1 * g[1]
        gz += SH_C1 * g[2]
    if degree >= 2:
        g4, g5, g6, g7, g8 = g[4], g[5], g[6], g[7], g[8]
        gx += SH_C2_XY * (y * g4 - z * g7) - 2 * SH_C2_ZZ * x * g6 + 2 * SH_C2_XX * x * g8
        gy += SH_C2_XY * (x * g4 - z * g5) - 2 * SH_C2_ZZ * y * g6 - 2 * SH_C2_XX * y * g8
        gz += 4 * SH_C2_ZZ * z * g6 - SH_C2_XY * (y * g5 + x * g7)
    if degree >= 3:
        g9, g10, g11, g12, g13, g14, g15 = g[9], g[10], g[11], g[12], g[13], g[14], g[15]
        xx, yy, zz, xy = x * x, y * y, z * z, x * y
        difference, ring = xx - yy, 4 * zz - xx - yy
        gx += -6 * SH_C3_3 * xy * g9 + SH_C3_2 * (y * z * g10 + x * z * g14) + 2 * SH_C3_1 * xy * g11
        gx += -6 * SH_C3_0 * x * z * g12 - SH_C3_1 * (ring - 2 * xx) * g13
        gx -= 3 * SH_C3_3 * difference * g15
        gy += -3 * SH_C3_3 * difference * g9 + SH_C3_2 * (x * z * g10 - y * z * g14)
        gy += -SH_C3_1 * (ring - 2 * yy) * g11 - 6 * SH_C3_0 * y * z * g12
        gy += 2 * SH_C3_1 * xy * g13 + 6 * SH_C3_3 * xy * g15
        gz += SH_C3_2 * (xy * g10 + 0.5 * difference * g14) - 8 * SH_C3_1 * z * (y * g11 + x * g13)
        gz += SH_C3_0 * (6 * zz - 3 * xx - 3 * yy) * g12
    return gx, gy, gz
