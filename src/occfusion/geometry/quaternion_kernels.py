"""Rotations of quaternions and their gradient, for kernels to compile into themselves.

What they are specified by is `rotation.quaternion_to_matrix`. Matrices are nine numbers, row by row, and no arrays:
they stay in registers, and need not be read again for fear that what was written elsewhere has changed them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from occfusion.cpu.compilation import inline
from occfusion.geometry.rotation import QUATERNION_FLOOR

Array = NDArray[np.float32]
Matrix = tuple[np.float32, ...]


@inline
def unit(quats: Array, n: int) -> tuple[np.float32, np.float32, np.float32, np.float32, np.float32]:
    """A unit quaternion and 1 / length; the identity and 0 without a direction."""
    w, x, y, z = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
    largest = max(max(abs(w), abs(x)), max(abs(y), abs(z)))
    if largest < np.float32(QUATERNION_FLOOR):  # what is not finite goes on, and shows
        zero = np.float32(0)
        return np.float32(1), zero, zero, zero, zero
    w, x, y, z = w / largest, x / largest, y / largest, z / largest
    inverse = np.float32(1) / np.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse / largest


@inline
def rotation(w: np.float32, x: np.float32, y: np.float32, z: np.float32) -> Matrix:
    """The rotation of a unit quaternion."""
    one, two = np.float32(1), np.float32(2)
    return (
        one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
        two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
        two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y),
    )  # fmt: skip


@inline
def to_quaternion(
    g: Matrix, w: np.float32, x: np.float32, y: np.float32, z: np.float32, inverse_length: np.float32
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """The gradient by a quaternion from that by its rotation; `unit` gave the others."""
    two = np.float32(2)
    # odd parts go with w, even parts pair the others
    wx, wy, wz = g[7] - g[5], g[2] - g[6], g[3] - g[1]
    xy, xz, yz = g[1] + g[3], g[2] + g[6], g[5] + g[7]
    a = two * (x * wx + y * wy + z * wz)
    b = two * (w * wx + y * xy + z * xz - two * x * (g[4] + g[8]))
    c = two * (w * wy + x * xy + z * yz - two * y * (g[0] + g[8]))
    d = two * (w * wz + x * xz + y * yz - two * z * (g[0] + g[4]))
    along = a * w + b * x + c * y + d * z
    return (
        (a - w * along) * inverse_length,
        (b - x * along) * inverse_length,
        (c - y * along) * inverse_length,
        (d - z * along) * inverse_length,
    )
