"""`carry.carry` a few Gaussians at a time instead of pass by pass: nothing between is written to memory and read again.

What is known of `LANES` Gaussians lies in columns of neighbouring numbers, so that the loops over them are vector code.
They run to the end of the columns, whatever is left there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from occfusion.cpu.compilation import inline, kernel, local_array, run_parts
from occfusion.geometry.rotation import QUATERNION_FLOOR

Array = NDArray[np.float32]
Numbers = tuple[np.float32, ...]
BLOCK = 1024
"""Gaussians that a thread takes at a time."""
LANES = 16
"""Of these, those that are handled side by side; divides `BLOCK`."""

# columns of what comes in
MEAN, QUAT, SCALE, OFFSET, REST, POSED = 0, 3, 7, 10, 13, 25
FOR_MOVED, FOR_COVARIANCE, FOR_LINEAR = 37, 40, 49
INPUTS, GRADIENTS = 37, 58
# of what goes out
MOVED, COVARIANCE, LINEAR = 0, 3, 12
TO_MEAN, TO_QUAT, TO_SCALE, TO_OFFSET, TO_POSED, TO_REST = 0, 3, 7, 10, 13, 25
OUTPUTS = 37

local_inputs = local_array((INPUTS, LANES), np.float32)
local_gradients = local_array((GRADIENTS, LANES), np.float32)
local_outputs = local_array((OUTPUTS, LANES), np.float32)


class Carry(torch.autograd.Function):
    """As `carry._Carry`, for float32 on a CPU."""

    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns centres `[N, 3]`, covariances `[N, 3, 3]` and linear maps `[3, 3, N]`."""
        ctx.set_materialize_grads(False)
        count = len(inputs[0])
        moved, covariances, linear = torch.empty(count, 3), torch.empty(count, 3, 3), torch.empty(3, 3, count)
        ctx.save_for_backward(*inputs)
        run_parts(
            _forward,
            *_flat(inputs),
            moved.numpy().reshape(-1),
            covariances.numpy().reshape(-1),
            linear.numpy().reshape(9, -1),
        )
        return moved, covariances, linear

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        """Returns the gradients of the inputs; None for maps to rest where they need none."""
        inputs = ctx.saved_tensors
        count = len(inputs[0])
        shapes = ((3 * count,), (9 * count,), (9, count))
        given = [
            np.zeros(shape, np.float32) if gradient is None else _array(gradient).reshape(shape)
            for shape, gradient in zip(shapes, gradients, strict=True)
        ]
        needs_rest = ctx.needs_input_grad[3]
        out = [torch.empty_like(tensor, memory_format=torch.contiguous_format) for tensor in inputs]
        if not needs_rest:
            out[3] = torch.empty(3, 4, 0)
        run_parts(_backward, *_flat(inputs), *given, needs_rest, *_flat(out))
        results: list[Tensor | None] = list(out)
        if not needs_rest:
            results[3] = None
        if gradients[1] is None:
            results[1] = results[2] = None
        return tuple(results)


def warm_up() -> None:
    """Compiles the kernels, or loads them from the cache: by no Gaussian."""
    shapes = ((0, 3), (0, 4), (0, 3), (3, 4, 0), (0, 3), (3, 4, 0))
    moved, covariances, linear = Carry.apply(*(torch.zeros(shape, requires_grad=True) for shape in shapes))
    (moved.sum() + covariances.sum() + linear.sum()).backward()


def _array(tensor: Tensor) -> Array:
    array: Array = tensor.detach().contiguous().numpy()
    return array


def _flat(tensors: Sequence[Tensor]) -> Iterator[Array]:
    """Yields the arrays of what `Carry` takes: rows one after the other, maps as twelve columns."""
    for tensor in tensors:
        array = _array(tensor)
        yield array.reshape(12, array.shape[2]) if array.ndim == 3 else array.reshape(-1)


@inline
def _load_rows(rows: Array, first: int, count: int, width: int, at: int, v: Array) -> None:
    """Puts so many Gaussians' rows into columns."""
    for k in range(count):
        for j in range(width):
            v[at + j, k] = rows[width * (first + k) + j]


@inline
def _load_columns(columns: Array, first: int, count: int, at: int, v: Array) -> None:
    """Puts so many Gaussians' columns, one after the other, into columns."""
    for j in range(len(columns)):
        for k in range(count):
            v[at + j, k] = columns[j, first + k]


@inline
def _store_rows(v: Array, at: int, width: int, first: int, count: int, rows: Array) -> None:
    for k in range(count):
        for j in range(width):
            rows[width * (first + k) + j] = v[at + j, k]


@inline
def _store_columns(v: Array, at: int, first: int, count: int, columns: Array) -> None:
    for j in range(len(columns)):
        for k in range(count):
            columns[j, first + k] = v[at + j, k]


@inline
def _three(v: Array, at: int, k: int) -> Numbers:
    return v[at, k], v[at + 1, k], v[at + 2, k]


@inline
def _matrix(v: Array, at: int, width: int, k: int) -> Numbers:
    """A 3 x 3 matrix of rows of this width, row by row."""
    a, b, c = _three(v, at, k)
    d, e, f = _three(v, at + width, k)
    g, h, i = _three(v, at + 2 * width, k)
    return a, b, c, d, e, f, g, h, i


@inline
def _put(v: Array, at: int, width: int, k: int, numbers: Numbers) -> None:
    """A 3 x 3 matrix into rows of this width."""
    v[at, k], v[at + 1, k], v[at + 2, k] = numbers[0], numbers[1], numbers[2]
    v[at + width, k], v[at + width + 1, k], v[at + width + 2, k] = numbers[3], numbers[4], numbers[5]
    at += 2 * width
    v[at, k], v[at + 1, k], v[at + 2, k] = numbers[6], numbers[7], numbers[8]


@inline
def _transposed(m: Numbers) -> Numbers:
    return m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]


@inline
def _applied(m: Numbers, x: Numbers) -> Numbers:
    return (
        m[0] * x[0] + m[1] * x[1] + m[2] * x[2],
        m[3] * x[0] + m[4] * x[1] + m[5] * x[2],
        m[6] * x[0] + m[7] * x[1] + m[8] * x[2],
    )


@inline
def _product(a: Numbers, b: Numbers) -> Numbers:
    m, n, o = (
        _applied(a, (b[0], b[3], b[6])),
        _applied(a, (b[1], b[4], b[7])),
        _applied(a, (b[2], b[5], b[8])),
    )
    return m[0], n[0], o[0], m[1], n[1], o[1], m[2], n[2], o[2]


@inline
def _sum(a: Numbers, b: Numbers) -> Numbers:
    return (
        a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5], a[6] + b[6], a[7] + b[7],
        a[8] + b[8],
    )  # fmt: skip


@inline
def _outer(x: Numbers, y: Numbers) -> Numbers:
    return (
        x[0] * y[0], x[0] * y[1], x[0] * y[2], x[1] * y[0], x[1] * y[1], x[1] * y[2], x[2] * y[0], x[2] * y[1],
        x[2] * y[2],
    )  # fmt: skip


@inline
def _scaled(m: Numbers, s: Numbers) -> Numbers:
    """Columns of a matrix times these numbers."""
    return (
        m[0] * s[0], m[1] * s[1], m[2] * s[2], m[3] * s[0], m[4] * s[1], m[5] * s[2], m[6] * s[0], m[7] * s[1],
        m[8] * s[2],
    )  # fmt: skip


@inline
def _unit(v: Array, k: int) -> Numbers:
    """A unit quaternion and 1 / length; the identity and 0 without a direction."""
    zero, one = np.float32(0), np.float32(1)
    w, x, y, z = v[QUAT, k], v[QUAT + 1, k], v[QUAT + 2, k], v[QUAT + 3, k]
    largest = max(max(abs(w), abs(x)), max(abs(y), abs(z)))
    without = largest < np.float32(QUATERNION_FLOOR)  # what is not finite goes on, and shows
    largest = one if without else largest
    w, x, y, z = w / largest, x / largest, y / largest, z / largest
    inverse = one / np.sqrt(one if without else w * w + x * x + y * y + z * z)
    if without:
        return one, zero, zero, zero, zero
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse / largest


@inline
def _rotation(q: Numbers) -> Numbers:
    w, x, y, z = q[0], q[1], q[2], q[3]
    one, two = np.float32(1), np.float32(2)
    return (
        one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
        two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
        two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y),
    )  # fmt: skip


@inline
def _at_rest(v: Array, rest: Numbers, k: int) -> Numbers:
    """Where a Gaussian is at rest."""
    x = _applied(rest, _three(v, MEAN, k))
    return (
        x[0] + v[REST + 3, k] + v[OFFSET, k],
        x[1] + v[REST + 7, k] + v[OFFSET + 1, k],
        x[2] + v[REST + 11, k] + v[OFFSET + 2, k],
    )


@inline
def _load(
    means: Array, quats: Array, scales: Array, rest: Array, offsets: Array, posed: Array, first: int, count: int,
    v: Array,
) -> None:  # fmt: skip
    _load_rows(means, first, count, 3, MEAN, v)
    _load_rows(quats, first, count, 4, QUAT, v)
    _load_rows(scales, first, count, 3, SCALE, v)
    _load_rows(offsets, first, count, 3, OFFSET, v)
    _load_columns(rest, first, count, REST, v)
    _load_columns(posed, first, count, POSED, v)


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
    v, out = local_inputs(), local_outputs()
    v[:] = np.float32(0)
    total = len(means) // 3
    for begin in range(part * BLOCK, total, parts * BLOCK):
        for first in range(begin, min(begin + BLOCK, total), LANES):
            count = min(LANES, total - first)
            _load(means, quats, scales, rest_maps, offsets, posed_maps, first, count, v)
            for k in range(LANES):
                rest, posed = _matrix(v, REST, 4, k), _matrix(v, POSED, 4, k)
                linear = _product(posed, rest)
                root = _scaled(_product(linear, _rotation(_unit(v, k))), _three(v, SCALE, k))
                x = _applied(posed, _at_rest(v, rest, k))
                for j in range(3):
                    out[MOVED + j, k] = x[j] + v[POSED + 4 * j + 3, k]
                _put(out, COVARIANCE, 3, k, _product(root, _transposed(root)))
                _put(out, LINEAR, 3, k, linear)
            _store_rows(out, MOVED, 3, first, count, moved)
            _store_rows(out, COVARIANCE, 9, first, count, covariances)
            _store_columns(out, LINEAR, first, count, linear_out)


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
    to_means: Array,
    to_quats: Array,
    to_scales: Array,
    to_rest_maps: Array,
    to_offsets: Array,
    to_posed_maps: Array,
    part: int,
    parts: int,
) -> None:
    v, out = local_gradients(), local_outputs()
    v[:] = np.float32(0)
    total = len(means) // 3
    two = np.float32(2)
    for begin in range(part * BLOCK, total, parts * BLOCK):
        for first in range(begin, min(begin + BLOCK, total), LANES):
            count = min(LANES, total - first)
            _load(means, quats, scales, rest_maps, offsets, posed_maps, first, count, v)
            _load_rows(for_moved, first, count, 3, FOR_MOVED, v)
            _load_rows(for_covariances, first, count, 9, FOR_COVARIANCE, v)
            _load_columns(for_linear, first, count, FOR_LINEAR, v)
            for k in range(LANES):
                rest, posed = _matrix(v, REST, 4, k), _matrix(v, POSED, 4, k)
                linear, s, q = _product(posed, rest), _three(v, SCALE, k), _unit(v, k)
                turn = _rotation(q)
                root = _scaled(_product(linear, turn), s)
                each, moved = _matrix(v, FOR_COVARIANCE, 3, k), _three(v, FOR_MOVED, k)
                to_rest = _applied(_transposed(posed), moved)
                to_root = _product(_sum(each, _transposed(each)), root)
                to_linear = _sum(
                    _product(to_root, _transposed(_scaled(turn, s))), _matrix(v, FOR_LINEAR, 3, k)
                )
                own = _product(_transposed(linear), to_root)
                for j in range(3):
                    out[TO_SCALE + j, k] = (
                        own[j] * turn[j] + own[3 + j] * turn[3 + j] + own[6 + j] * turn[6 + j]
                    )
                own = _scaled(own, s)
                w, x, y, z = q[0], q[1], q[2], q[3]
                # odd parts go with w, even parts pair the others
                wx, wy, wz = own[7] - own[5], own[2] - own[6], own[3] - own[1]
                xy, xz, yz = own[1] + own[3], own[2] + own[6], own[5] + own[7]
                a = two * (x * wx + y * wy + z * wz)
                b = two * (w * wx + y * xy + z * xz - two * x * (own[4] + own[8]))
                c = two * (w * wy + x * xy + z * yz - two * y * (own[0] + own[8]))
                d = two * (w * wz + x * xz + y * yz - two * z * (own[0] + own[4]))
                along = a * w + b * x + c * y + d * z
                out[TO_QUAT, k], out[TO_QUAT + 1, k] = (a - w * along) * q[4], (b - x * along) * q[4]
                out[TO_QUAT + 2, k], out[TO_QUAT + 3, k] = (c - y * along) * q[4], (d - z * along) * q[4]
                to_mean, to_posed = _applied(_transposed(rest), to_rest), _outer(moved, _at_rest(v, rest, k))
                for j in range(3):
                    out[TO_MEAN + j, k], out[TO_OFFSET + j, k] = to_mean[j], to_rest[j]
                    out[TO_POSED + 4 * j + 3, k], out[TO_REST + 4 * j + 3, k] = moved[j], to_rest[j]
                _put(out, TO_POSED, 4, k, _sum(to_posed, _product(to_linear, _transposed(rest))))
                to_map = _product(_transposed(posed), to_linear)
                _put(out, TO_REST, 4, k, _sum(_outer(to_rest, _three(v, MEAN, k)), to_map))
            _store_rows(out, TO_MEAN, 3, first, count, to_means)
            _store_rows(out, TO_QUAT, 4, first, count, to_quats)
            _store_rows(out, TO_SCALE, 3, first, count, to_scales)
            _store_rows(out, TO_OFFSET, 3, first, count, to_offsets)
            _store_columns(out, TO_POSED, first, count, to_posed_maps)
            if needs_rest:
                _store_columns(out, TO_REST, first, count, to_rest_maps)
