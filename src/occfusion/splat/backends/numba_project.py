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
def fill_root(quats: Any, scales: Any, i: int, out: Any) -> None:
    """Writes rotation times scales, the square root of the covariance, to `out` `[9]`, row by row."""
    w, x, y, z, _ = unit_quaternion(quats, i)
    sx, sy, sz = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
    out[0] = (1 - 2 * (y * y + z * z)) * sx
    out[1] = 2 * (x * y - w * z) * sy
    out[2] = 2 * (x * z + w * y) * sz
    out[3] = 2 * (x * y + w * z) * sx
    out[4] = (1 - 2 * (x * x + z * z)) * sy
    out[5] = 2 * (y * z - w * x) * sz
    out[6] = 2 * (x * z - w * y) * sx
    out[7] = 2 * (y * z + w * x) * sy
    out[8] = (1 - 2 * (x * x + y * y)) * sz


@inline
def fill_affine(camera: Any, x: float, y: float, z: float, out: Any) -> None:
    """Writes the two rows of Jacobian times view rotation to `out` `[6]`; `camera` is by `pack_camera`."""
    inverse_z = 1 / z
    slope_x = min(max(x * inverse_z, camera[16]), camera[17])
    slope_y = min(max(y * inverse_z, camera[18]), camera[19])
    kx, ky = camera[12] * inverse_z, camera[13] * inverse_z
    for j in range(3):
        out[j] = kx * (camera[j] - slope_x * camera[6 + j])
        out[3 + j] = ky * (camera[3 + j] - slope_y * camera[6 + j])


@inline
def plane_from_root(affine: Any, root: Any) -> tuple[float, float, float, float]:
    """Returns a, b, c and the determinant of the projected covariance from its square root."""
    rx0 = affine[0] * root[0] + affine[1] * root[3] + affine[2] * root[6]
    rx1 = affine[0] * root[1] + affine[1] * root[4] + affine[2] * root[7]
    rx2 = affine[0] * root[2] + affine[1] * root[5] + affine[2] * root[8]
    ry0 = affine[3] * root[0] + affine[4] * root[3] + affine[5] * root[6]
    ry1 = affine[3] * root[1] + affine[4] * root[4] + affine[5] * root[7]
    ry2 = affine[3] * root[2] + affine[4] * root[5] + affine[5] * root[8]
    c0, c1, c2 = rx1 * ry2 - rx2 * ry1, rx2 * ry0 - rx0 * ry2, rx0 * ry1 - rx1 * ry0
    a, b = rx0 * rx0 + rx1 * rx1 + rx2 * rx2, rx0 * ry0 + rx1 * ry1 + rx2 * ry2
    return a, b, ry0 * ry0 + ry1 * ry1 + ry2 * ry2, c0 * c0 + c1 * c1 + c2 * c2


@inline
def plane_from_covariance(affine: Any, cov: Any, i: int) -> tuple[float, float, float, float]:
    """Returns a, b, c and the determinant of the projected covariance; the symmetric part is used."""
    xx, yy, zz = np.float64(cov[i, 0, 0]), np.float64(cov[i, 1, 1]), np.float64(cov[i, 2, 2])
    xy = 0.5 * (np.float64(cov[i, 0, 1]) + np.float64(cov[i, 1, 0]))
    xz = 0.5 * (np.float64(cov[i, 0, 2]) + np.float64(cov[i, 2, 0]))
    yz = 0.5 * (np.float64(cov[i, 1, 2]) + np.float64(cov[i, 2, 1]))
    p0, p1, p2, q0, q1, q2 = affine[0], affine[1], affine[2], affine[3], affine[4], affine[5]
    sp0, sp1, sp2 = xx * p0 + xy * p1 + xz * p2, xy * p0 + yy * p1 + yz * p2, xz * p0 + yz * p1 + zz * p2
    sq0, sq1, sq2 = xx * q0 + xy * q1 + xz * q2, xy * q0 + yy * q1 + yz * q2, xz * q0 + yz * q1 + zz * q2
    a = max(p0 * sp0 + p1 * sp1 + p2 * sp2, 0.0)
    b = q0 * sp0 + q1 * sp1 + q2 * sp2
    c = max(q0 * sq0 + q1 * sq1 + q2 * sq2, 0.0)
    return a, b, c, max(a * c - b * b, 0.0)


@kernel
def project_part(
    means: Any, quats: Any, scales: Any, covariances: Any, opacities: Any, colors: Any, offsets: Any,
    camera: Any, window: Any, options: Any, degree: int, splats: Any, radii: Any, part: int, parts: int,
) -> None:  # fmt: skip
    """Writes a row of `splats` `[N, 16]` and of `radii` for each visible Gaussian; REACH is 0 for the others.

    Absent inputs have no rows. `window` is the range of pixel centres wanted (x0, x1, y0, y1);
    `options` is (near, dilation, alpha_min, antialiased); `degree` is -1 for plain colours.
    """
    n = means.shape[0]
    near, dilation, alpha_min, antialiased = options[0], options[1], options[2], options[3] != 0
    log_alpha_min = math.log(alpha_min)
    root, affine, basis = np.empty(9), np.empty(6), np.empty(16, np.float32)
    bands = (degree + 1) ** 2
    for begin in range(part * PART, n, parts * PART):
        for i in range(begin, min(n, begin + PART)):
            splats[i, REACH] = 0
            wx, wy, wz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            z = camera[6] * wx + camera[7] * wy + camera[8] * wz + camera[11]
            opacity = np.float64(opacities[i])
            if not (z > near) or not (opacity > alpha_min):
                continue
            x = camera[0] * wx + camera[1] * wy + camera[2] * wz + camera[9]
            y = camera[3] * wx + camera[4] * wy + camera[5] * wz + camera[10]
            mx, my = camera[12] * x / z + camera[14], camera[13] * y / z + camera[15]
            if offsets.shape[0] > 0:
                mx += offsets[i, 0]
                my += offsets[i, 1]
            fill_affine(camera, x, y, z, affine)
            if covariances.shape[0] > 0:
                a, b, c, flat = plane_from_covariance(affine, covariances, i)
            else:
                fill_root(quats, scales, i, root)
                a, b, c, flat = plane_from_root(affine, root)
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
            splats[i, X_WHOLE] = np.floor(mx)
            splats[i, X_PART] = mx - np.floor(mx)
            splats[i, Y_WHOLE] = np.floor(my)
            splats[i, Y_PART] = my - np.floor(my)
            splats[i, L1] = root_c / root_det
            splats[i, M] = -b / (root_c * root_det)
            splats[i, L2] = 1 / root_c
            splats[i, LOG_OPACITY] = log_opacity + EXP_SHIFT
            splats[i, DEPTH] = z
            splats[i, REACH] = reach
            splats[i, HALF_HEIGHT] = ry
            splats[i, TURN] = b * root_reach / root_a
            splats[i, INVERSE_L1] = root_det / root_c
            if degree < 0:
                splats[i, RED] = colors[i, 0, 0]
                splats[i, GREEN] = colors[i, 0, 1]
                splats[i, BLUE] = colors[i, 0, 2]
                continue
            dx, dy, dz = wx - camera[20], wy - camera[21], wz - camera[22]
            inverse = 1 / math.sqrt(dx * dx + dy * dy + dz * dz)
            fill_basis(dx * inverse, dy * inverse, dz * inverse, degree, basis)
            red = green = blue = np.float32(0.5)
            for k in range(bands):
                red += basis[k] * colors[i, k, 0]
                green += basis[k] * colors[i, k, 1]
                blue += basis[k] * colors[i, k, 2]
            splats[i, RED] = max(red, np.float32(0))
            splats[i, GREEN] = max(green, np.float32(0))
            splats[i, BLUE] = max(blue, np.float32(0))
