"""Projection of one Gaussian, in float64 (the formulas are those of `splat.projection`).

No branches: the loops that use these become vector code.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from occfusion.cpu.compilation import inline
from occfusion.splat.limits import QUATERNION_FLOOR


@inline
def unit_quaternion(w: float, x: float, y: float, z: float) -> tuple[float, float, float, float, float]:
    """Returns w, x, y, z of length 1 and the inverse of the length it had; 0 for no rotation."""
    is_none = max(abs(w), abs(x), abs(y), abs(z)) < QUATERNION_FLOOR
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
    row_x: tuple[float, ...], row_y: tuple[float, ...], cov: tuple[float, ...]
) -> tuple[float, float, float, float]:
    """Returns a, b, c and the determinant of the projected covariance; `cov` is by `symmetric_part`."""
    xx, yy, zz, xy, xz, yz = cov
    sq0, sq1, sq2 = dot(row_y, xx, xy, xz), dot(row_y, xy, yy, yz), dot(row_y, xz, yz, zz)
    a = max(dot(row_x, dot(row_x, xx, xy, xz), dot(row_x, xy, yy, yz), dot(row_x, xz, yz, zz)), 0.0)
    b = dot(row_x, sq0, sq1, sq2)
    c = max(dot(row_y, sq0, sq1, sq2), 0.0)
    return a, b, c, max(a * c - b * b, 0.0)


@inline
def ray_of(x: float, y: float, z: float, camera: Any) -> tuple[float, float, float, float]:
    """Returns the unit direction from the camera centre to a point, and the inverse of their distance."""
    dx, dy, dz = x - camera[20], y - camera[21], z - camera[22]
    inverse = 1 / math.sqrt(dx * dx + dy * dy + dz * dz)
    return dx * inverse, dy * inverse, dz * inverse, inverse
