"""Rotations in numpy, float64: axis-angles, quaternions (w, x, y, z), matrices, slerp."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TINY_ANGLE = 1e-8  # radians; below, sin(a/2)/a is 1/2 to double precision


def quaternion_from_axis_angle(axis_angle: Floats) -> Floats:
    """Returns unit quaternions, `[..., 4]`, of axis-angles `[..., 3]` in radians."""
    angle = np.linalg.norm(axis_angle, axis=-1, keepdims=True)
    small = angle < TINY_ANGLE
    factor = np.where(small, 0.5, np.sin(0.5 * angle) / np.where(small, 1.0, angle))
    return np.concatenate([np.cos(0.5 * angle), axis_angle * factor], axis=-1)


def axis_angle_from_quaternion(quaternion: Floats) -> Floats:
    """Returns axis-angles, `[..., 3]`, at most pi long."""
    quaternion = np.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quaternion[..., :1])
    small = sine < TINY_ANGLE
    return quaternion[..., 1:] * np.where(small, 2.0, angle / np.where(small, 1.0, sine))


def matrix_from_quaternion(quaternion: Floats) -> Floats:
    """Returns rotation matrices, `[..., 3, 3]`, of unit quaternions."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_from_axis_angle(axis_angle: Floats) -> Floats:
    """Returns rotation matrices, `[..., 3, 3]` (Rodrigues)."""
    return matrix_from_quaternion(quaternion_from_axis_angle(axis_angle))


def multiply(a: Floats, b: Floats) -> Floats:
    """Returns the quaternion product: first `b`, then `a`."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def slerp(a: Floats, b: Floats, t: Floats | float) -> Floats:
    """Returns the rotation a share `t` of the shorter way from `a` to `b`; `t` broadcasts over `[...]`."""
    share = np.asarray(t, dtype=np.float64)[..., None]
    cosine = np.sum(a * b, axis=-1, keepdims=True)
    b = np.where(cosine < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    near = sine < TINY_ANGLE
    safe = np.where(near, 1.0, sine)
    left = np.where(near, 1.0 - share, np.sin((1.0 - share) * angle) / safe)
    right = np.where(near, share, np.sin(share * angle) / safe)
    out = left * a + right * b
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


def about_y(angle: Floats | float) -> Floats:
    """Returns the quaternion of a turn about the y axis, `[..., 4]`, radians."""
    half = 0.5 * np.asarray(angle, dtype=np.float64)
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, np.sin(half), zero], axis=-1)
