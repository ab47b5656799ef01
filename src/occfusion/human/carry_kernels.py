"""`carry.carry` Gaussian by Gaussian instead of pass by pass: nothing between is written to memory and read again."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from occfusion.cpu.compilation import array_of, inline, kernel, run_parts
from occfusion.geometry.quaternion_kernels import Array, Matrix, rotation, to_quaternion, unit

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


Vector = tuple[np.float32, np.float32, np.float32]


@inline
def _columns(maps: Array, n: int) -> Matrix:
    """The linear part of a Gaussian's map, or a matrix of `[3, 3, N]`."""
    return (
        maps[0, 0, n], maps[0, 1, n], maps[0, 2, n],
        maps[1, 0, n], maps[1, 1, n], maps[1, 2, n],
        maps[2, 0, n], maps[2, 1, n], maps[2, 2, n],
    )  # fmt: skip


@inline
def _transposed(a: Matrix) -> Matrix:
    return a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8]


@inline
def _scaled(a: Matrix, x: np.float32, y: np.float32, z: np.float32) -> Matrix:
    """A matrix with its columns multiplied."""
    return a[0] * x, a[1] * y, a[2] * z, a[3] * x, a[4] * y, a[5] * z, a[6] * x, a[7] * y, a[8] * z


@inline
def _row(x: np.float32, y: np.float32, z: np.float32, b: Matrix) -> Vector:
    """A row times a matrix."""
    return x * b[0] + y * b[3] + z * b[6], x * b[1] + y * b[4] + z * b[7], x * b[2] + y * b[5] + z * b[8]


@inline
def _product(a: Matrix, b: Matrix) -> Matrix:
    return _row(a[0], a[1], a[2], b) + _row(a[3], a[4], a[5], b) + _row(a[6], a[7], a[8], b)


@inline
def _sum(a: Matrix, b: Matrix) -> Matrix:
    return (
        a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5], a[6] + b[6], a[7] + b[7],
        a[8] + b[8],
    )  # fmt: skip


@inline
def _outer(
    x: np.float32, y: np.float32, z: np.float32, p: np.float32, q: np.float32, r: np.float32
) -> Matrix:
    return x * p, x * q, x * r, y * p, y * q, y * r, z * p, z * q, z * r


@inline
def _applied(a: Matrix, x: np.float32, y: np.float32, z: np.float32) -> Vector:
    return a[0] * x + a[1] * y + a[2] * z, a[3] * x + a[4] * y + a[5] * z, a[6] * x + a[7] * y + a[8] * z


@inline
def _at_rest(means: Array, offsets: Array, rest_maps: Array, n: int, rest: Matrix) -> Vector:
    x, y, z = _applied(rest, means[n, 0], means[n, 1], means[n, 2])
    return (
        x + rest_maps[0, 3, n] + offsets[n, 0],
        y + rest_maps[1, 3, n] + offsets[n, 1],
        z + rest_maps[2, 3, n] + offsets[n, 2],
    )


@inline
def _put(maps: Array, n: int, a: Matrix) -> None:
    """Writes a matrix as `_columns` reads it."""
    maps[0, 0, n], maps[0, 1, n], maps[0, 2, n] = a[0], a[1], a[2]
    maps[1, 0, n], maps[1, 1, n], maps[1, 2, n] = a[3], a[4], a[5]
    maps[2, 0, n], maps[2, 1, n], maps[2, 2, n] = a[6], a[7], a[8]


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
    for begin in range(part * BLOCK, len(means), parts * BLOCK):
        for n in range(begin, min(begin + BLOCK, len(means))):
            rest, posed = _columns(rest_maps, n), _columns(posed_maps, n)
            linear = _product(posed, rest)
            w, x, y, z, _ = unit(quats, n)
            turned = _product(linear, rotation(w, x, y, z))
            root = _scaled(turned, scales[n, 0], scales[n, 1], scales[n, 2])
            square = _product(root, _transposed(root))
            x, y, z = _at_rest(means, offsets, rest_maps, n, rest)
            x, y, z = _applied(posed, x, y, z)
            moved[n, 0], moved[n, 1] = x + posed_maps[0, 3, n], y + posed_maps[1, 3, n]
            moved[n, 2] = z + posed_maps[2, 3, n]
            _put(linear_out, n, linear)
            for k in range(9):
                covariances[n, k // 3, k % 3] = square[k]


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
    two = np.float32(2)
    for begin in range(part * BLOCK, len(means), parts * BLOCK):
        for n in range(begin, min(begin + BLOCK, len(means))):
            rest, posed = _columns(rest_maps, n), _columns(posed_maps, n)
            linear = _product(posed, rest)
            w, x, y, z, inverse_length = unit(quats, n)
            turn = rotation(w, x, y, z)
            sx, sy, sz = scales[n, 0], scales[n, 1], scales[n, 2]
            mx, my, mz = for_moved[n, 0], for_moved[n, 1], for_moved[n, 2]
            each = for_covariances[n]
            xy, xz, yz = each[0, 1] + each[1, 0], each[0, 2] + each[2, 0], each[1, 2] + each[2, 1]
            twice = (two * each[0, 0], xy, xz, xy, two * each[1, 1], yz, xz, yz, two * each[2, 2])
            to_root = _product(twice, _scaled(_product(linear, turn), sx, sy, sz))
            own = _product(_transposed(linear), to_root)
            to_linear = _sum(
                _product(to_root, _transposed(_scaled(turn, sx, sy, sz))), _columns(for_linear, n)
            )
            to_scales[n, 0] = own[0] * turn[0] + own[3] * turn[3] + own[6] * turn[6]
            to_scales[n, 1] = own[1] * turn[1] + own[4] * turn[4] + own[7] * turn[7]
            to_scales[n, 2] = own[2] * turn[2] + own[5] * turn[5] + own[8] * turn[8]
            own = _scaled(own, sx, sy, sz)
            to_quats[n, 0], to_quats[n, 1], to_quats[n, 2], to_quats[n, 3] = to_quaternion(
                own, w, x, y, z, inverse_length
            )
            rx, ry, rz = _row(mx, my, mz, posed)
            to_means[n, 0], to_means[n, 1], to_means[n, 2] = _row(rx, ry, rz, rest)
            if needs_offsets:
                to_offsets[n, 0], to_offsets[n, 1], to_offsets[n, 2] = rx, ry, rz
            if needs_posed:
                px, py, pz = _at_rest(means, offsets, rest_maps, n, rest)
                to = _sum(_product(to_linear, _transposed(rest)), _outer(mx, my, mz, px, py, pz))
                _put(to_posed_maps, n, to)
                to_posed_maps[0, 3, n], to_posed_maps[1, 3, n], to_posed_maps[2, 3, n] = mx, my, mz
            if needs_rest:
                px, py, pz = means[n, 0], means[n, 1], means[n, 2]
                to = _sum(_product(_transposed(posed), to_linear), _outer(rx, ry, rz, px, py, pz))
                _put(to_rest_maps, n, to)
                to_rest_maps[0, 3, n], to_rest_maps[1, 3, n], to_rest_maps[2, 3, n] = rx, ry, rz
