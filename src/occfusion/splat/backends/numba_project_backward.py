"""From gradients on the picture to gradients of the Gaussians and the camera, in float64."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from occfusion.splat.backends.numba_compile import inline, kernel
from occfusion.splat.backends.numba_harmonics import direction_gradient, fill_basis
from occfusion.splat.backends.numba_layout import (
    BLUE,
    G_BLUE,
    G_DEPTH,
    G_GREEN,
    G_POWER,
    G_RED,
    G_U,
    G_UX,
    G_UY,
    G_V,
    G_VY,
    GRADIENT_SIZE,
    GREEN,
    L1,
    L2,
    RED,
    M,
)
from occfusion.splat.backends.numba_pairs import sum_pairs
from occfusion.splat.backends.numba_project import (
    PART,
    fill_affine,
    fill_root,
    plane_from_covariance,
    plane_from_root,
    unit_quaternion,
)
from occfusion.splat.limits import COMPENSATION_FLOOR


@inline
def factor_gradient(
    a: float, b: float, c: float, det: float, g_l1: float, g_m: float, g_l2: float
) -> tuple[float, float, float]:
    """Returns the gradient of the dilated covariance entries a, b, c from that of its factor.

    l1 = sqrt(c / det), m = -b / sqrt(c det), l2 = 1 / sqrt(c), det = a c - b^2.
    """
    inverse_c, inverse_det = 1 / math.sqrt(c), 1 / math.sqrt(det)
    l1, m = c * inverse_c * inverse_det, -b * inverse_c * inverse_det
    over_det = inverse_det * inverse_det
    along_l1, along_m = g_l1 * l1 * over_det, g_m * over_det
    g_a = -0.5 * c * (along_l1 + along_m * m)
    g_b = along_l1 * b - along_m * a * c * inverse_c * inverse_det
    g_c = along_l1 * b * b + along_m * m * (det + a * c) + g_l2 * inverse_c
    g_c *= -0.5 * inverse_c * inverse_c
    return g_a, g_b, g_c


@inline
def ray_of(x: float, y: float, z: float, camera: Any) -> tuple[float, float, float, float]:
    """Returns the unit direction from the camera centre to a point, and the inverse of their distance."""
    dx, dy, dz = x - camera[20], y - camera[21], z - camera[22]
    inverse = 1 / math.sqrt(dx * dx + dy * dy + dz * dz)
    return dx * inverse, dy * inverse, dz * inverse, inverse


@inline
def root_gradient(
    quats: Any, scales: Any, i: int, affine: Any, root: Any, g_a: float, g_b: float, g_c: float,
    g_affine: Any, g_root: Any, g_quats: Any, g_scales: Any,
) -> None:  # fmt: skip
    """Adds up the gradients of rotation, scales and affine rows when the covariance is their product."""
    for j in range(9):
        g_root[j] = 0.0
    for j in range(6):
        g_affine[j] = 0.0
    for k in range(3):
        rx = affine[0] * root[k] + affine[1] * root[3 + k] + affine[2] * root[6 + k]
        ry = affine[3] * root[k] + affine[4] * root[3 + k] + affine[5] * root[6 + k]
        g_rx, g_ry = 2 * g_a * rx + g_b * ry, 2 * g_c * ry + g_b * rx
        for j in range(3):
            g_affine[j] += root[3 * j + k] * g_rx
            g_affine[3 + j] += root[3 * j + k] * g_ry
            g_root[3 * j + k] = affine[j] * g_rx + affine[3 + j] * g_ry
    w, x, y, z, inverse = unit_quaternion(quats, i)
    if g_scales.shape[0] > 0:
        r0, r1, r2 = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
        g_scales[i, 0] = g_root[0] * r0 + g_root[3] * r1 + g_root[6] * r2
        r0, r1, r2 = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)
        g_scales[i, 1] = g_root[1] * r0 + g_root[4] * r1 + g_root[7] * r2
        r0, r1, r2 = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
        g_scales[i, 2] = g_root[2] * r0 + g_root[5] * r1 + g_root[8] * r2
    if g_quats.shape[0] > 0:
        for k in range(3):
            for j in range(3):
                g_root[3 * j + k] *= scales[i, k]
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = (
            g_root[0], g_root[1], g_root[2], g_root[3], g_root[4], g_root[5], g_root[6], g_root[7], g_root[8]
        )  # fmt: skip
        gw = 2 * (z * (r10 - r01) + y * (r02 - r20) + x * (r21 - r12))
        gx = 2 * (y * (r01 + r10) + z * (r02 + r20) + w * (r21 - r12) - 2 * x * (r11 + r22))
        gy = 2 * (x * (r01 + r10) + z * (r12 + r21) + w * (r02 - r20) - 2 * y * (r00 + r22))
        gz = 2 * (x * (r02 + r20) + y * (r12 + r21) + w * (r10 - r01) - 2 * z * (r00 + r11))
        along = w * gw + x * gx + y * gy + z * gz
        g_quats[i, 0] = (gw - w * along) * inverse
        g_quats[i, 1] = (gx - x * along) * inverse
        g_quats[i, 2] = (gy - y * along) * inverse
        g_quats[i, 3] = (gz - z * along) * inverse


@inline
def covariance_gradient(
    cov: Any, i: int, affine: Any, g_a: float, g_b: float, g_c: float, g_affine: Any, g_cov: Any
) -> None:
    """Writes the gradients of the (symmetrised) covariance and of the affine rows."""
    for j in range(3):
        sp = sq = 0.0
        for k in range(3):
            s = 0.5 * (np.float64(cov[i, j, k]) + np.float64(cov[i, k, j]))
            sp += s * affine[k]
            sq += s * affine[3 + k]
        g_affine[j] = 2 * g_a * sp + g_b * sq
        g_affine[3 + j] = 2 * g_c * sq + g_b * sp
        if g_cov.shape[0] > 0:
            for k in range(3):
                pp, qq = affine[j] * affine[k], affine[3 + j] * affine[3 + k]
                pq = affine[j] * affine[3 + k] + affine[3 + j] * affine[k]
                g_cov[i, j, k] = g_a * pp + 0.5 * g_b * pq + g_c * qq


@kernel
def project_backward_part(
    means: Any, quats: Any, scales: Any, covariances: Any, opacities: Any, colors: Any,
    camera: Any, options: Any, degree: int, splats: Any, slots: Any, pair_slots: Any,
    g_means: Any, g_quats: Any, g_scales: Any, g_covariances: Any, g_opacities: Any, g_colors: Any,
    g_offsets: Any, g_camera: Any, part: int, parts: int,
) -> None:  # fmt: skip
    """Writes the gradients of the visible Gaussians; a gradient that nobody asked for has no rows.

    `slots` `[N + 1]` delimits the rows of `pair_slots` of each. `g_camera` `[pieces, 12]` gets the
    gradient of rotation and translation, one row for every `PART` Gaussians.
    """
    dilation, antialiased = options[1], options[3] != 0
    wants_camera = g_camera.shape[0] > 0
    wants_place = wants_camera or g_means.shape[0] > 0
    wants_shape = wants_place or g_quats.shape[0] + g_scales.shape[0] + g_covariances.shape[0] > 0
    root, affine, g_root, g_affine = np.empty(9), np.empty(6), np.empty(9), np.empty(6)
    basis, g_basis, pair = np.empty(16, np.float32), np.empty(16, np.float32), np.empty(GRADIENT_SIZE)
    g_rows = np.empty(12)
    bands = (degree + 1) ** 2
    count = means.shape[0]
    for begin in range(part * PART, count, parts * PART):
        for k in range(12):
            g_rows[k] = 0.0
        for i in range(begin, min(count, begin + PART)):
            seen = sum_pairs(pair_slots, slots[i], slots[i + 1], pair)
            if g_colors.shape[0] > 0:  # the largest array comes as it was allocated
                for k in range(max(bands, 1) if seen else 0, g_colors.shape[1]):
                    for channel in range(3):
                        g_colors[i, k, channel] = 0
            if not seen:
                continue
            l1, m, l2 = np.float64(splats[i, L1]), np.float64(splats[i, M]), np.float64(splats[i, L2])
            g_mx, g_my = l1 * pair[G_U], m * pair[G_U] + l2 * pair[G_V]
            if g_offsets.shape[0] > 0:
                g_offsets[i, 0], g_offsets[i, 1] = g_mx, g_my
            # the clamp at zero of the harmonics' colour lets nothing through
            g_red = np.float32(pair[G_RED] if degree < 0 or splats[i, RED] > 0 else 0.0)
            g_green = np.float32(pair[G_GREEN] if degree < 0 or splats[i, GREEN] > 0 else 0.0)
            g_blue = np.float32(pair[G_BLUE] if degree < 0 or splats[i, BLUE] > 0 else 0.0)
            if degree < 0 and g_colors.shape[0] > 0:
                g_colors[i, 0, 0], g_colors[i, 0, 1], g_colors[i, 0, 2] = g_red, g_green, g_blue
            wx, wy, wz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            g_wx = g_wy = g_wz = 0.0
            if degree >= 0 and g_colors.shape[0] > 0:
                dx, dy, dz, _ = ray_of(wx, wy, wz, camera)
                fill_basis(dx, dy, dz, degree, basis)
                for k in range(bands):
                    g_colors[i, k, 0] = basis[k] * g_red
                    g_colors[i, k, 1] = basis[k] * g_green
                    g_colors[i, k, 2] = basis[k] * g_blue
            if degree > 0 and wants_place:
                dx, dy, dz, inverse = ray_of(wx, wy, wz, camera)
                for k in range(bands):
                    g_basis[k] = colors[i, k, 0] * g_red + colors[i, k, 1] * g_green
                    g_basis[k] += colors[i, k, 2] * g_blue
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
                    g_opacities[i] = pair[G_POWER] / opacity
                continue
            x = camera[0] * wx + camera[1] * wy + camera[2] * wz + camera[9]
            y = camera[3] * wx + camera[4] * wy + camera[5] * wz + camera[10]
            z = camera[6] * wx + camera[7] * wy + camera[8] * wz + camera[11]
            fill_affine(camera, x, y, z, affine)
            if covariances.shape[0] > 0:
                a0, b, c0, flat = plane_from_covariance(affine, covariances, i)
            else:
                fill_root(quats, scales, i, root)
                a0, b, c0, flat = plane_from_root(affine, root)
            det = flat + dilation * (a0 + c0) + dilation * dilation
            a, c = a0 + dilation, c0 + dilation
            g_a, g_b, g_c = factor_gradient(a, b, c, det, -pair[G_UX], -pair[G_UY], -pair[G_VY])
            if antialiased:
                ratio = flat / det
                if ratio > COMPENSATION_FLOOR:
                    # gradient of log opacity is G_POWER; log mass = log(flat / det) / 2
                    g_ratio = 0.5 * pair[G_POWER] / ratio
                    g_a += g_ratio * (c0 - ratio * c) / det
                    g_b -= 2 * g_ratio * (1 - ratio) * b / det
                    g_c += g_ratio * (a0 - ratio * a) / det
            if g_opacities.shape[0] > 0:
                g_opacities[i] = pair[G_POWER] / opacity
            if not wants_shape:
                continue
            if covariances.shape[0] > 0:
                covariance_gradient(covariances, i, affine, g_a, g_b, g_c, g_affine, g_covariances)
            else:
                root_gradient(
                    quats, scales, i, affine, root, g_a, g_b, g_c, g_affine, g_root, g_quats, g_scales
                )  # fmt: skip
            if not wants_place:
                continue
            inverse_z = 1 / z
            kx, ky = camera[12] * inverse_z, camera[13] * inverse_z
            free_x, free_y = x * inverse_z, y * inverse_z
            slope_x = min(max(free_x, camera[16]), camera[17])
            slope_y = min(max(free_y, camera[18]), camera[19])
            g_x, g_y = g_mx * kx, g_my * ky
            # what is multiplied by 1 / z: the centre's distance from the axis, and the affine rows
            g_log_z = -(g_x * x + g_y * y)
            g_slope_x = g_slope_y = 0.0
            for j in range(3):
                g_log_z -= g_affine[j] * affine[j] + g_affine[3 + j] * affine[3 + j]
                g_slope_x -= kx * g_affine[j] * camera[6 + j]
                g_slope_y -= ky * g_affine[3 + j] * camera[6 + j]
                if wants_camera:
                    g_rows[j] += kx * g_affine[j]
                    g_rows[3 + j] += ky * g_affine[3 + j]
                    g_rows[6 + j] -= kx * slope_x * g_affine[j] + ky * slope_y * g_affine[3 + j]
            # a slope that was clamped does not follow the centre
            if slope_x == free_x:
                g_x += g_slope_x * inverse_z
                g_log_z -= g_slope_x * free_x
            if slope_y == free_y:
                g_y += g_slope_y * inverse_z
                g_log_z -= g_slope_y * free_y
            g_z = pair[G_DEPTH] + g_log_z * inverse_z
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
                g_means[i, 0] = g_wx + camera[0] * g_x + camera[3] * g_y + camera[6] * g_z
                g_means[i, 1] = g_wy + camera[1] * g_x + camera[4] * g_y + camera[7] * g_z
                g_means[i, 2] = g_wz + camera[2] * g_x + camera[5] * g_y + camera[8] * g_z
        if wants_camera:
            for k in range(12):
                g_camera[begin // PART, k] = g_rows[k]
