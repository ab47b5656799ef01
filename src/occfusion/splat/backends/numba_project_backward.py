"""From gradients on the picture to gradients of the Gaussians and the camera, in float64."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from occfusion.splat.backends.numba_compile import inline, kernel
from occfusion.splat.backends.numba_harmonics import direction_gradient, fill_basis
from occfusion.splat.backends.numba_layout import (
    BLUE,
    GREEN,
    L1,
    L2,
    RED,
    M,
)
from occfusion.splat.backends.numba_pairs import sum_pairs
from occfusion.splat.backends.numba_project import (
    PART,
    affine_of,
    dot,
    plane_from_covariance,
    plane_from_root,
    rotation_of,
    symmetric_part,
    unit_quaternion,
)
from occfusion.splat.limits import COMPENSATION_FLOOR


@inline
def factor_gradient(
    a: float, b: float, c: float, det: float, l1: float, l2: float, g_l1: float, g_m: float, g_l2: float
) -> tuple[float, float, float]:
    """Returns the gradient of the dilated covariance entries a, b, c from that of its factor.

    l1 = sqrt(c / det), m = -b / sqrt(c det), l2 = 1 / sqrt(c), det = a c - b^2. As stored, l1 and l2 are rounded
    to single precision; they scale whole sums, so nothing that cancels is touched by it.
    """
    scale = l1 * l2  # 1 / sqrt(det)
    scale *= scale * scale * l2  # det^-3/2 c^-1/2
    g_a = -0.5 * c * scale * (g_l1 * c - g_m * b)
    g_b = scale * c * (g_l1 * b - g_m * a)
    g_c = scale * b * (g_l1 * c * b - g_m * (det + a * c)) + g_l2 * l2
    return g_a, g_b, -0.5 * l2 * l2 * g_c


@inline
def ray_of(x: float, y: float, z: float, camera: Any) -> tuple[float, float, float, float]:
    """Returns the unit direction from the camera centre to a point, and the inverse of their distance."""
    dx, dy, dz = x - camera[20], y - camera[21], z - camera[22]
    inverse = 1 / math.sqrt(dx * dx + dy * dy + dz * dz)
    return dx * inverse, dy * inverse, dz * inverse, inverse


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
    row_x: tuple[float, ...], row_y: tuple[float, ...], quaternion: tuple[float, ...], rotation: tuple[float, ...],
    scales: Any, i: int, g_a: float, g_b: float, g_c: float, g_quats: Any, g_scales: Any,
) -> tuple[tuple[float, ...], tuple[float, ...]]:  # fmt: skip
    """Writes the gradients of rotation and scales when the covariance is their product; returns the affine rows'."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
    sx, sy, sz = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
    px, qx, x0, x1, x2 = axis_gradient(row_x, row_y, r00, r10, r20, sx, g_a, g_b, g_c)
    py, qy, y0, y1, y2 = axis_gradient(row_x, row_y, r01, r11, r21, sy, g_a, g_b, g_c)
    pz, qz, z0, z1, z2 = axis_gradient(row_x, row_y, r02, r12, r22, sz, g_a, g_b, g_c)
    if g_scales.shape[0] > 0:
        g_scales[i, 0] = x0 * r00 + x1 * r10 + x2 * r20
        g_scales[i, 1] = y0 * r01 + y1 * r11 + y2 * r21
        g_scales[i, 2] = z0 * r02 + z1 * r12 + z2 * r22
    if g_quats.shape[0] > 0:
        w, x, y, z, inverse = quaternion
        x0, x1, x2, y0, y1, y2, z0, z1, z2 = (
            x0 * sx, x1 * sx, x2 * sx, y0 * sy, y1 * sy, y2 * sy, z0 * sz, z1 * sz, z2 * sz,
        )  # fmt: skip
        gw = 2 * (z * (x1 - y0) + y * (z0 - x2) + x * (y2 - z1))
        gx = 2 * (y * (y0 + x1) + z * (z0 + x2) + w * (y2 - z1) - 2 * x * (y1 + z2))
        gy = 2 * (x * (y0 + x1) + z * (z1 + y2) + w * (z0 - x2) - 2 * y * (x0 + z2))
        gz = 2 * (x * (z0 + x2) + y * (z1 + y2) + w * (x1 - y0) - 2 * z * (x0 + y1))
        along = w * gw + x * gx + y * gy + z * gz
        g_quats[i, 0] = (gw - w * along) * inverse
        g_quats[i, 1] = (gx - x * along) * inverse
        g_quats[i, 2] = (gy - y * along) * inverse
        g_quats[i, 3] = (gz - z * along) * inverse
    px, py, pz, qx, qy, qz = px * sx, py * sy, pz * sz, qx * sx, qy * sy, qz * sz
    return (
        (r00 * px + r01 * py + r02 * pz, r10 * px + r11 * py + r12 * pz, r20 * px + r21 * py + r22 * pz),
        (r00 * qx + r01 * qy + r02 * qz, r10 * qx + r11 * qy + r12 * qz, r20 * qx + r21 * qy + r22 * qz),
    )


@inline
def covariance_gradient(
    cov: Any,
    i: int,
    row_x: tuple[float, ...],
    row_y: tuple[float, ...],
    g_a: float,
    g_b: float,
    g_c: float,
    g_cov: Any,
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Writes the gradient of the (symmetrised) covariance; returns the affine rows'."""
    xx, yy, zz, xy, xz, yz = symmetric_part(cov, i)
    p0, p1, p2 = dot(row_x, xx, xy, xz), dot(row_x, xy, yy, yz), dot(row_x, xz, yz, zz)
    q0, q1, q2 = dot(row_y, xx, xy, xz), dot(row_y, xy, yy, yz), dot(row_y, xz, yz, zz)
    if g_cov.shape[0] > 0:
        for j in range(3):
            for k in range(3):
                pp, qq = row_x[j] * row_x[k], row_y[j] * row_y[k]
                pq = row_x[j] * row_y[k] + row_y[j] * row_x[k]
                g_cov[i, j, k] = g_a * pp + 0.5 * g_b * pq + g_c * qq
    return (
        (2 * g_a * p0 + g_b * q0, 2 * g_a * p1 + g_b * q1, 2 * g_a * p2 + g_b * q2),
        (2 * g_c * q0 + g_b * p0, 2 * g_c * q1 + g_b * p1, 2 * g_c * q2 + g_b * p2),
    )


@kernel
def project_backward_part(
    means: Any, quats: Any, scales: Any, covariances: Any, opacities: Any, colors: Any,
    camera: Any, options: Any, degree: int, splats: Any, slots: Any, pair_slots: Any,
    g_means: Any, g_quats: Any, g_scales: Any, g_covariances: Any, g_opacities: Any, g_colors: Any,
    g_offsets: Any, g_camera: Any, wants_camera: bool, all_basis: Any, part: int, parts: int,
) -> None:  # fmt: skip
    """Writes the gradients of the visible Gaussians; a gradient that nobody asked for has no rows.

    `colors` and their gradient are `[N, 3 K]`. `slots` `[N + 1]` delimits the rows of `pair_slots` of each.
    `g_camera` `[pieces, 12]`, zeros, gets that of rotation and translation, one row for every `PART` Gaussians.
    `all_basis` is working space.
    """
    dilation, antialiased = options[1], options[3] != 0
    wants_place = wants_camera or g_means.shape[0] > 0
    wants_shape = wants_place or g_quats.shape[0] + g_scales.shape[0] + g_covariances.shape[0] > 0
    basis, g_basis = all_basis[part, 0], all_basis[part, 1]
    bands = (degree + 1) * (degree + 1)
    r00, r01, r02, r10, r11, r12 = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    r20, r21, r22, tx, ty, tz = camera[6], camera[7], camera[8], camera[9], camera[10], camera[11]
    count = means.shape[0]
    for begin in range(part * PART, count, parts * PART):
        g_rows = g_camera[begin // PART]
        for i in range(begin, min(count, begin + PART)):
            u, v, ux, uy, vy, power, red, green, blue, far = sum_pairs(pair_slots, slots[i], slots[i + 1])
            seen = u != 0 or v != 0 or ux != 0 or uy != 0 or vy != 0 or power != 0
            seen = seen or red != 0 or green != 0 or blue != 0 or far != 0
            if g_colors.shape[0] > 0:  # the largest array comes as it was allocated
                for k in range(3 * max(bands, 1) if seen else 0, g_colors.shape[1]):
                    g_colors[i, k] = 0
            if not seen:
                continue
            splat = splats[i]
            l1, m, l2 = np.float64(splat[L1]), np.float64(splat[M]), np.float64(splat[L2])
            g_mx, g_my = l1 * u, m * u + l2 * v
            if g_offsets.shape[0] > 0:
                g_offsets[i, 0], g_offsets[i, 1] = g_mx, g_my
            # the clamp at zero of the harmonics' colour lets nothing through
            g_red = np.float32(red if degree < 0 or splat[RED] > 0 else 0.0)
            g_green = np.float32(green if degree < 0 or splat[GREEN] > 0 else 0.0)
            g_blue = np.float32(blue if degree < 0 or splat[BLUE] > 0 else 0.0)
            if degree < 0 and g_colors.shape[0] > 0:
                g_colors[i, 0], g_colors[i, 1], g_colors[i, 2] = g_red, g_green, g_blue
            wx, wy, wz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            g_wx = g_wy = g_wz = 0.0
            dx, dy, dz, inverse = ray_of(wx, wy, wz, camera) if degree >= 0 else (0.0, 0.0, 0.0, 0.0)
            if degree >= 0 and g_colors.shape[0] > 0:
                fill_basis(dx, dy, dz, degree, basis)
                row = g_colors[i]
                for k in range(bands):
                    row[3 * k], row[3 * k + 1], row[3 * k + 2] = (
                        basis[k] * g_red,
                        basis[k] * g_green,
                        basis[k] * g_blue,
                    )
            if degree > 0 and wants_place:
                row = colors[i]
                for k in range(bands):
                    g_basis[k] = row[3 * k] * g_red + row[3 * k + 1] * g_green + row[3 * k + 2] * g_blue
                gx, gy, gz = direction_gradient(dx, dy, dz, degree, g_basis)
                along = gx * dx + gy * dy + gz * dz
                g_wx, g_wy = (gx - along * dx) * inverse, (gy - along * dy) * inverse
                g_wz = (gz - along * dz) * inverse
                if wants_camera:
                    # the ray is mean + rotation^T translation
                    for j in range(3):
                        r0, r1, r2, t = camera[3 * j], camera[3 * j + 1], camera[3 * j + 2], camera[9 + j]
                        g_rows[3 * j] += t * g_wx
                        g_rows[3 * j + 1] += t * g_wy
                        g_rows[3 * j + 2] += t * g_wz
                        g_rows[9 + j] += r0 * g_wx + r1 * g_wy + r2 * g_wz
            opacity = np.float64(opacities[i])
            if not wants_shape and not antialiased:
                if g_opacities.shape[0] > 0:
                    g_opacities[i] = power / opacity
                continue
            x = r00 * wx + r01 * wy + r02 * wz + tx
            y = r10 * wx + r11 * wy + r12 * wz + ty
            z = r20 * wx + r21 * wy + r22 * wz + tz
            row_x, row_y = affine_of(camera, x, y, z)
            if covariances.shape[0] > 0:
                quaternion = (1.0, 0.0, 0.0, 0.0, 0.0)
                rotation = rotation_of(1.0, 0.0, 0.0, 0.0)
                a0, b, c0, flat = plane_from_covariance(row_x, row_y, covariances, i)
            else:
                quaternion = unit_quaternion(quats, i)
                rotation = rotation_of(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
                sx, sy, sz = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
                a0, b, c0, flat = plane_from_root(row_x, row_y, rotation, sx, sy, sz)
            det = flat + dilation * (a0 + c0) + dilation * dilation
            a, c = a0 + dilation, c0 + dilation
            g_a, g_b, g_c = factor_gradient(a, b, c, det, l1, l2, -ux, -uy, -vy)
            if antialiased:
                ratio = flat / det
                if ratio > COMPENSATION_FLOOR:
                    # gradient of log opacity is G_POWER; log mass = log(flat / det) / 2
                    g_ratio = 0.5 * power / ratio
                    g_a += g_ratio * (c0 - ratio * c) / det
                    g_b -= 2 * g_ratio * (1 - ratio) * b / det
                    g_c += g_ratio * (a0 - ratio * a) / det
            if g_opacities.shape[0] > 0:
                g_opacities[i] = power / opacity
            if not wants_shape:
                continue
            if covariances.shape[0] > 0:
                g_row_x, g_row_y = covariance_gradient(
                    covariances, i, row_x, row_y, g_a, g_b, g_c, g_covariances
                )
            else:
                g_row_x, g_row_y = root_gradient(
                    row_x, row_y, quaternion, rotation, scales, i, g_a, g_b, g_c, g_quats, g_scales
                )
            if not wants_place:
                continue
            inverse_z = 1 / z
            kx, ky = camera[12] * inverse_z, camera[13] * inverse_z
            free_x, free_y = x * inverse_z, y * inverse_z
            slope_x = min(max(free_x, camera[16]), camera[17])
            slope_y = min(max(free_y, camera[18]), camera[19])
            g_x, g_y = g_mx * kx, g_my * ky
            # what is multiplied by 1 / z: the centre's distance from the axis, and the affine rows
            g_log_z = -(g_x * x + g_y * y) - dot(g_row_x, row_x[0], row_x[1], row_x[2])
            g_log_z -= dot(g_row_y, row_y[0], row_y[1], row_y[2])
            g_slope_x = -kx * dot(g_row_x, r20, r21, r22)
            g_slope_y = -ky * dot(g_row_y, r20, r21, r22)
            if wants_camera:
                for j in range(3):
                    g_rows[j] += kx * g_row_x[j]
                    g_rows[3 + j] += ky * g_row_y[j]
                    g_rows[6 + j] -= kx * slope_x * g_row_x[j] + ky * slope_y * g_row_y[j]
            # a slope that was clamped does not follow the centre
            if slope_x == free_x:
                g_x += g_slope_x * inverse_z
                g_log_z -= g_slope_x * free_x
            if slope_y == free_y:
                g_y += g_slope_y * inverse_z
                g_log_z -= g_slope_y * free_y
            g_z = far + g_log_z * inverse_z
            if wants_camera:
                for j in range(3):
                    w = means[i, j]
                    g_rows[j] += g_x * w
                    g_rows[3 + j] += g_y * w
                    g_rows[6 + j] += g_z * w
                g_rows[9] += g_x
                g_rows[10] += g_y
                g_rows[11] += g_z
            if g_means.shape[0] > 0:
                g_means[i, 0] = g_wx + r00 * g_x + r10 * g_y + r20 * g_z
                g_means[i, 1] = g_wy + r01 * g_x + r11 * g_y + r21 * g_z
                g_means[i, 2] = g_wz + r02 * g_x + r12 * g_y + r22 * g_z
