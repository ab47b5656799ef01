"""Rotations the slow way: the exponential series of the cross-product matrix, quaternion products."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from occfusion.geometry.rotation import matrix_to_quaternion


def cross_matrix(vector):
    x, y, z = (float(value) for value in vector)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exponential(vector, halvings=60):
    """exp of the cross-product matrix: 12 terms of the series for the vector / 2^k, squared k times."""
    vector = np.asarray(vector, dtype=np.longdouble)
    k = 0
    while np.abs(vector).max() > 0.05 and k < halvings:
        vector, k = vector / 2, k + 1
    x, y, z = vector
    zero = np.longdouble(0)
    m = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    term = total = np.eye(3, dtype=np.longdouble)
    for n in range(1, 13):
        term = term @ m / n
        total = total + term
    for _ in range(k):
        total = total @ total
    return total.astype(np.float64)


def conjugate(quaternion):
    """Rotation matrix from the products q e q* of Hamilton's quaternions, one basis vector at a time."""
    q = np.asarray(quaternion, dtype=np.float64)
    q = q / np.sqrt((q * q).sum())
    back = q * np.array([1.0, -1.0, -1.0, -1.0])
    columns = []
    for axis in range(3):
        e = np.zeros(4)
        e[1 + axis] = 1.0
        columns.append(hamilton(hamilton(q, e), back)[1:])
    return np.stack(columns, axis=1)


def hamilton(p, q):
    """Product of two quaternions (w, x, y, z): scalar and vector parts written out."""
    scalar = p[0] * q[0] - np.dot(p[1:], q[1:])
    vector = p[0] * np.asarray(q[1:]) + q[0] * np.asarray(p[1:]) + np.cross(p[1:], q[1:])
    return np.concatenate([[scalar], vector])


def quaternion_to_axis_angle(quats: Tensor) -> Tensor:
    """Returns the axis-angle vectors `[..., 3]`, angle in 0..pi radians, of quaternions `[..., 4]`."""
    unit = quats / quats.norm(dim=-1, keepdim=True)
    unit = torch.where(unit[..., :1] < 0, -unit, unit)
    real, imaginary = unit[..., :1], unit[..., 1:]
    squared = (imaginary * imaginary).sum(-1, keepdim=True)
    is_small = squared < 1e-4
    length = torch.where(is_small, 1.0, squared).sqrt()
    # angle = 2 atan2(length, real); near 0 the series of atan(u) / u in u = length / real
    ratio = squared / torch.where(is_small, real, 1.0) ** 2
    series = 2 * (1 - ratio * (1 / 3 - ratio * (1 / 5 - ratio * (1 / 7 - ratio / 9))))
    near = series / torch.where(is_small, real, 1.0)
    far = 2 * torch.atan2(length, real) / length
    return torch.where(is_small, near, far) * imaginary


def matrix_to_axis_angle(matrices: Tensor) -> Tensor:
    """Returns the axis-angle vectors `[..., 3]`, angle in 0..pi radians, of rotations `[..., 3, 3]`."""
    return quaternion_to_axis_angle(matrix_to_quaternion(matrices))
