"""`rotation.axis_angle_to_matrix` vector by vector, with the gradient written out.

Two dozen joints are two dozen tiny operations to autograd, there and back.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from occfusion.cpu.compilation import array_of, inline, kernel

Array = NDArray[np.float32]
SERIES_BELOW = 1e-2
"""Squared angle under which series are used: the first term left out is below 1e-12 there."""


class AxisAngle(torch.autograd.Function):
    """Rotation matrices `[M, 3, 3]` of axis-angles `[M, 3]`, for float32 on a CPU; computed in float64."""

    @staticmethod
    def forward(ctx: Any, vectors: Tensor) -> Tensor:
        """Returns the matrices."""
        matrices = torch.empty(len(vectors), 3, 3)
        ctx.save_for_backward(vectors)
        fill_rotations(array_of(vectors), matrices.numpy())
        return matrices

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """Returns the gradient by the vectors."""
        (vectors,) = ctx.saved_tensors
        found = torch.empty(vectors.shape)
        _backward(array_of(vectors), array_of(gradient), found.numpy())
        return found


def warm_up() -> None:
    """Compiles the kernels, or loads them from the cache: by no rotation."""
    AxisAngle.apply(torch.zeros(0, 3, requires_grad=True)).sum().backward()


@inline
def _ratios(q: float) -> tuple[float, float, float, float]:
    """sin(a) / a and (1 - cos(a)) / a^2 of an angle of square `q`, and their derivatives by that square."""
    if q < SERIES_BELOW:
        return (
            1 - q / 6 * (1 - q / 20 * (1 - q / 42 * (1 - q / 72))),
            0.5 * (1 - q / 12 * (1 - q / 30 * (1 - q / 56 * (1 - q / 90)))),
            -1 / 6 + q / 60 - q * q / 1680 + q * q * q / 90720,
            -1 / 24 + q / 360 - q * q / 13440 + q * q * q / 907200,
        )
    angle = math.sqrt(q)
    sine, half = math.sin(angle), math.sin(0.5 * angle)
    first, second = sine / angle, 2 * half * half / q
    return first, second, (1 - 2 * half * half - first) / (2 * q), (first / 2 - second) / q


@kernel
def fill_rotations(vectors: NDArray[Any], matrices: NDArray[Any]) -> None:
    """Gives rotation matrices `[M, 3, 3]` of axis-angles `[M, 3]`, of either precision; computed in float64."""
    for m in range(len(vectors)):
        x, y, z = np.float64(vectors[m, 0]), np.float64(vectors[m, 1]), np.float64(vectors[m, 2])
        q = x * x + y * y + z * z
        first, second, _, _ = _ratios(q)
        cosine = 1 - second * q
        matrices[m, 0, 0] = cosine + second * x * x
        matrices[m, 1, 1] = cosine + second * y * y
        matrices[m, 2, 2] = cosine + second * z * z
        matrices[m, 0, 1] = second * x * y - first * z
        matrices[m, 1, 0] = second * x * y + first * z
        matrices[m, 0, 2] = second * x * z + first * y
        matrices[m, 2, 0] = second * x * z - first * y
        matrices[m, 1, 2] = second * y * z - first * x
        matrices[m, 2, 1] = second * y * z + first * x


@kernel
def _backward(vectors: Array, gradient: Array, found: Array) -> None:
    for m in range(len(vectors)):
        x, y, z = np.float64(vectors[m, 0]), np.float64(vectors[m, 1]), np.float64(vectors[m, 2])
        g = gradient[m]
        q = x * x + y * y + z * z
        first, second, by_first, by_second = _ratios(q)
        trace = np.float64(g[0, 0]) + g[1, 1] + g[2, 2]
        # odd parts go with the sine, even parts with the cosine
        a, b, c = np.float64(g[2, 1]) - g[1, 2], np.float64(g[0, 2]) - g[2, 0], np.float64(g[1, 0]) - g[0, 1]
        xy, xz, yz = (
            np.float64(g[0, 1]) + g[1, 0],
            np.float64(g[0, 2]) + g[2, 0],
            np.float64(g[1, 2]) + g[2, 1],
        )
        u = 2 * np.float64(g[0, 0]) * x + xy * y + xz * z
        v = xy * x + 2 * np.float64(g[1, 1]) * y + yz * z
        w = xz * x + yz * y + 2 * np.float64(g[2, 2]) * z
        along = (u * x + v * y + w * z) / 2
        radial = 2 * (by_second * (along - q * trace) + by_first * (a * x + b * y + c * z) - second * trace)
        found[m, 0] = second * u + first * a + radial * x
        found[m, 1] = second * v + first * b + radial * y
        found[m, 2] = second * w + first * c + radial * z
