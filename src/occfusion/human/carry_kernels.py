"""`carry.carry` Gaussian by Gaussian instead of pass by pass: nothing between is written to memory and read again."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from occfusion.cpu.compilation import array_of, inline, kernel, run_parts
from occfusion.geometry.rotation import QUATERNION_FLOOR

Array = NDArray[np.float32]
BLOCK = 1024
"""Gaussians that a thread takes at a time."""


class Carry(torch.autograd.Function):
    """As `carry._Carry`, for float32 on a CPU."""

    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns centres `[N, 3]`, covariances `[N, 3, 3]` and linear maps `[3, 3, N]`."""
        ctx.set_materialize_grads(False)
        count = len(inputs[0])
        moved, covariances, linear = torch.empty(count, 3), torch.empty(count, 3, 3), torch.empty(3, 3, count)
        ctx.save_for_backward(*inputs)
        run_parts(_forward, *map(array_of, inputs), moved.numpy(), covariances.numpy(), linear.numpy())
        return moved, covariances, linear

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        """Returns the gradients of the inputs; None for maps and displacements that need none."""
        inputs = ctx.saved_tensors
        count = len(inputs[0])
        shapes = ((count, 3), (count, 3, 3), (3, 3, count))
        given = [
            np.zeros(shape, np.float32) if gradient is None else array_of(gradient)
            for shape, gradient in zip(shapes, gradients, strict=True)
        ]
        needs_rest, needs_offsets, needs_posed = needs = ctx.needs_input_grad[3:]
        out = [torch.empty_like(tensor, memory_format=torch.contiguous_format) for tensor in inputs[:3]]
        for shape, is_needed in zip(((3, 4, count), (count, 3), (3, 4, count)), needs, strict=True):
            # of a frame whose pose is not mended nothing but the Gaussians' own is asked
            out.append(torch.empty(shape) if is_needed else torch.empty([0] * len(shape)))
        run_parts(
            _backward, *map(array_of, inputs), *given, needs_rest, needs_offsets, needs_posed,
            *(tensor.numpy() for tensor in out),
        )  # fmt: skip
        results: list[Tensor | None] = [
            *out[:3],
            *(o if n else None for o, n in zip(out[3:], needs, strict=True)),
        ]
        if gradients[1] is None:
            results[1] = results[2] = None
        return tuple(results)


def warm_up() -> None:
    """Compiles the kernels, or loads them from the cache: by no Gaussian."""
    shapes = ((0, 3), (0, 4), (0, 3), (3, 4, 0), (0, 3), (3, 4, 0))
    moved, covariances, linear = Carry.apply(*(torch.zeros(shape, requires_grad=True) for shape in shapes))
    (moved.sum() + covariances.sum() + linear.sum()).backward()


@inline
def _unit(quats: Array, n: int) -> tuple[np.float32, np.float32, np.float32, np.float32, np.float32]:
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
def _rotation(w: np.float32, x: np.float32, y: np.float32, z: np.float32, out: Array) -> None:
    one, two = np.float32(1), np.float32(2)
    out[0, 0] = one - two * (y * y + z * z)
    out[0, 1] = two * (x * y - w * z)
    out[0, 2] = two * (x * z + w * y)
    out[1, 0] = two * (x * y + w * z)
    out[1, 1] = one - two * (x * x + z * z)
    out[1, 2] = two * (y * z - w * x)
    out[2, 0] = two * (x * z - w * y)
    out[2, 1] = two * (y * z + w * x)
    out[2, 2] = one - two * (x * x + y * y)


@inline
def _maps(rest_maps: Array, posed_maps: Array, n: int, rest: Array, posed: Array, linear: Array) -> None:
    """The linear parts of both maps of a Gaussian, and their product."""
    for i in range(3):
        for j in range(3):
            rest[i, j], posed[i, j] = rest_maps[i, j, n], posed_maps[i, j, n]
    for i in range(3):
        for j in range(3):
            linear[i, j] = posed[i, 0] * rest[0, j] + posed[i, 1] * rest[1, j] + posed[i, 2] * rest[2, j]


@inline
def _placed(
    means: Array,
    scales: Array,
    rest_maps: Array,
    offsets: Array,
    n: int,
    rest: Array,
    linear: Array,
    turn: Array,
    at_rest: Array,
    root: Array,
) -> None:
    """Where a Gaussian is at rest, and the root of its covariance in the pose."""
    for i in range(3):
        at_rest[i] = (
            rest[i, 0] * means[n, 0] + rest[i, 1] * means[n, 1] + rest[i, 2] * means[n, 2]
            + rest_maps[i, 3, n] + offsets[n, i]
        )  # fmt: skip
        for j in range(3):
            root[i, j] = scales[n, j] * (
                linear[i, 0] * turn[0, j] + linear[i, 1] * turn[1, j] + linear[i, 2] * turn[2, j]
            )


@kernel
def _forward(
    means: Array,
    quats: Array,
    scales: Array,
    rest_maps: Array,
    offsets: Array,
    posed_maps: Array,
    moved: Array,
    covariances: Array,
    linear_out: Array,
    part: int,
    parts: int,
) -> None:
    space = np.empty((5, 3, 3), np.float32)
    rest, posed, linear, turn, root = space[0], space[1], space[2], space[3], space[4]
    at_rest = np.empty(3, np.float32)
    for begin in range(part * BLOCK, len(means), parts * BLOCK):
        for n in range(begin, min(begin + BLOCK, len(means))):
            _maps(rest_maps, posed_maps, n, rest, posed, linear)
            w, x, y, z, _ = _unit(quats, n)
            _rotation(w, x, y, z, turn)
            _placed(means, scales, rest_maps, offsets, n, rest, linear, turn, at_rest, root)
            for i in range(3):
                for j in range(3):
                    linear_out[i, j, n] = linear[i, j]
            for i in range(3):
                moved[n, i] = (
                    posed[i, 0] * at_rest[0] + posed[i, 1] * at_rest[1] + posed[i, 2] * at_rest[2]
                    + posed_maps[i, 3, n]
                )  # fmt: skip
                for j in range(3):
                    covariances[n, i, j] = (
                        root[i, 0] * root[j, 0] + root[i, 1] * root[j, 1] + root[i, 2] * root[j, 2]
                    )


@kernel
def _backward(
    means: Array,
    quats: Array,
    scales: Array,
    rest_maps: Array,
    offsets: Array,
    posed_maps: Array,
    for_moved: Array,
    for_covariances: Array,
    for_linear: Array,
    needs_rest: bool,
    needs_offsets: bool,
    needs_posed: bool,
    to_means: Array,
    to_quats: Array,
    to_scales: Array,
    to_rest_maps: Array,
    to_offsets: Array,
    to_posed_maps: Array,
    part: int,
    parts: int,
) -> None:
    space = np.empty((8, 3, 3), np.float32)
    rest, posed, linear, turn, root = space[0], space[1], space[2], space[3], space[4]
    to_root, to_linear, own = space[5], space[6], space[7]
    at_rest, to_rest = np.empty(3, np.float32), np.empty(3, np.float32)
    two = np.float32(2)
    for begin in range(part * BLOCK, len(means), parts * BLOCK):
        for n in range(begin, min(begin + BLOCK, len(means))):
            _maps(rest_maps, posed_maps, n, rest, posed, linear)
            w, x, y, z, inverse_length = _unit(quats, n)
            _rotation(w, x, y, z, turn)
            _placed(means, scales, rest_maps, offsets, n, rest, linear, turn, at_rest, root)
            for i in range(3):
                to_rest[i] = (
                    posed[0, i] * for_moved[n, 0]
                    + posed[1, i] * for_moved[n, 1]
                    + posed[2, i] * for_moved[n, 2]
                )
            for i in range(3):
                for j in range(3):
                    total = np.float32(0)
                    for k in range(3):
                        total += (for_covariances[n, i, k] + for_covariances[n, k, i]) * root[k, j]
                    to_root[i, j] = total
            for i in range(3):
                for j in range(3):
                    total, mine = for_linear[i, j, n], np.float32(0)
                    for k in range(3):
                        total += to_root[i, k] * turn[j, k] * scales[n, k]
                        mine += linear[k, i] * to_root[k, j]
                    to_linear[i, j], own[i, j] = total, mine
            for j in range(3):
                to_scales[n, j] = own[0, j] * turn[0, j] + own[1, j] * turn[1, j] + own[2, j] * turn[2, j]
            for i in range(3):
                for j in range(3):
                    own[i, j] *= scales[n, j]
            # odd parts go with w, even parts pair the others
            wx, wy, wz = own[2, 1] - own[1, 2], own[0, 2] - own[2, 0], own[1, 0] - own[0, 1]
            xy, xz, yz = own[0, 1] + own[1, 0], own[0, 2] + own[2, 0], own[1, 2] + own[2, 1]
            a = two * (x * wx + y * wy + z * wz)
            b = two * (w * wx + y * xy + z * xz - two * x * (own[1, 1] + own[2, 2]))
            c = two * (w * wy + x * xy + z * yz - two * y * (own[0, 0] + own[2, 2]))
            d = two * (w * wz + x * xz + y * yz - two * z * (own[0, 0] + own[1, 1]))
            along = a * w + b * x + c * y + d * z
            to_quats[n, 0] = (a - w * along) * inverse_length
            to_quats[n, 1] = (b - x * along) * inverse_length
            to_quats[n, 2] = (c - y * along) * inverse_length
            to_quats[n, 3] = (d - z * along) * inverse_length
            for i in range(3):
                to_means[n, i] = rest[0, i] * to_rest[0] + rest[1, i] * to_rest[1] + rest[2, i] * to_rest[2]
            if needs_offsets:
                for i in range(3):
                    to_offsets[n, i] = to_rest[i]
            if needs_posed:
                for i in range(3):
                    to_posed_maps[i, 3, n] = for_moved[n, i]
                    for j in range(3):
                        to_posed_maps[i, j, n] = for_moved[n, i] * at_rest[j] + (
                            to_linear[i, 0] * rest[j, 0]
                            + to_linear[i, 1] * rest[j, 1]
                            + to_linear[i, 2] * rest[j, 2]
                        )
            if needs_rest:
                for i in range(3):
                    to_rest_maps[i, 3, n] = to_rest[i]
                    for j in range(3):
                        to_rest_maps[i, j, n] = to_rest[i] * means[n, j] + (
                            posed[0, i] * to_linear[0, j]
                            + posed[1, i] * to_linear[1, j]
                            + posed[2, i] * to_linear[2, j]
                        )
