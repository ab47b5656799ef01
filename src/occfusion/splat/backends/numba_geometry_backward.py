"""Gradients of the projection of one Gaussian, in float64; no branches, for the reason given in `numba_geometry`."""

from __future__ import annotations

from occfusion.cpu.compilation import inline
from occfusion.splat.backends.numba_geometry import dot, rotation_of


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
