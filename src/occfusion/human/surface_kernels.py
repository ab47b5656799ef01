"""`surface_terms` Gaussian by Gaussian, with the gradients written out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from occfusion.cpu.compilation import array_of, inline, kernel, run_parts
from occfusion.geometry.quaternion_kernels import Array, Matrix, rotation, to_quaternion, unit
from occfusion.human.gaussians import MAX_SCALE, MIN_SCALE, Gaussians
from occfusion.human.surface_terms import (
    DEPTH_SCALE,
    EXTENT_SCALE,
    HELD_FROM,
    INWARDS,
    LEAST_COSINE,
    LONG,
    OUTWARDS,
    THICK,
    TILT_SCALE,
    WIDE,
    KnownSurface,
)

Rows = NDArray[np.int64]
BLOCK = 1024
"""Gaussians that a thread takes at a time."""
SMALLEST, LARGEST = math.log(MIN_SCALE), math.log(MAX_SCALE)


class _DepthAndExtent(torch.autograd.Function):
    """Both means `[2]`; their gradients are found on the way."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, log_scales: Tensor, rows: Tensor, dressed: Tensor, axis: Tensor,
        ignorance: Tensor,
    ) -> Tensor:  # fmt: skip
        costs = torch.empty(2, len(means))
        found = [torch.empty(t.shape) for t in (means, quats, log_scales)]
        run_parts(
            _costs, *map(array_of, (means, quats, log_scales, rows, dressed, axis, ignorance)), costs.numpy(),
            *(tensor.numpy() for tensor in found),
        )  # fmt: skip
        ctx.save_for_backward(*found)
        return costs.mean(dim=1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        to_means, to_quats, to_log_scales = ctx.saved_tensors
        depth, extent = gradient / max(len(to_means), 1)
        return depth * to_means, extent * to_quats, extent * to_log_scales, None, None, None, None


def depth_and_extent(gaussians: Gaussians, surface: KnownSurface) -> tuple[Tensor, Tensor]:
    """As `surface_terms.depth_and_extent`."""
    depth, extent = _DepthAndExtent.apply(
        gaussians.means, gaussians.raw_quats, gaussians.log_scales, gaussians.vertex_index,
        surface.dressed, surface.axis, surface.ignorance,
    )  # fmt: skip
    return depth, extent


class _Tilt(torch.autograd.Function):
    """The mean; its gradient is found on the way."""

    @staticmethod
    def forward(
        ctx: Any, quats: Tensor, log_scales: Tensor, rows: Tensor, normals: Tensor, ignorance: Tensor
    ) -> Tensor:
        costs, found = torch.empty(len(quats)), torch.empty(quats.shape)
        run_parts(
            _tilts,
            *map(array_of, (quats, log_scales, rows, normals, ignorance)),
            costs.numpy(),
            found.numpy(),
        )
        ctx.save_for_backward(found)
        return costs.mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (to_quats,) = ctx.saved_tensors
        return gradient / max(len(to_quats), 1) * to_quats, None, None, None, None


def tilt(gaussians: Gaussians, surface: KnownSurface) -> Tensor:
    """As `surface_terms.tilt`."""
    cost: Tensor = _Tilt.apply(
        gaussians.raw_quats, gaussians.log_scales, gaussians.vertex_index, surface.normals, surface.ignorance
    )
    return cost


def hold(gaussians: Gaussians, surface: KnownSurface) -> None:
    """As `surface_terms.hold`, but for the count of changes of the parameters."""
    run_parts(
        _hold, gaussians.means.detach().numpy(), array_of(gaussians.raw_quats),
        gaussians.log_scales.detach().numpy(), array_of(gaussians.vertex_index),
        *map(array_of, (
            surface.vertices, surface.normals, surface.thickness, surface.axis, surface.ignorance, surface.sizes,
        )),
    )  # fmt: skip


def warm_up() -> None:
    """Compiles the kernels, or loads them from the cache: by no Gaussian."""
    points, values = torch.zeros(0, 3), torch.zeros(0)
    gaussians = Gaussians(torch.zeros(0, 3), torch.ones(0, 3), 0)
    surface = KnownSurface(points, points, points, values, points, values, values)
    depth, extent = depth_and_extent(gaussians, surface)
    (depth + extent + tilt(gaussians, surface)).backward()
    hold(gaussians, surface)


@inline
def _along(turn: Matrix, axis: Array, v: int) -> tuple[np.float32, np.float32, np.float32]:
    """A direction in the axes of a Gaussian."""
    x, y, z = axis[v, 0], axis[v, 1], axis[v, 2]
    return (
        turn[0] * x + turn[3] * y + turn[6] * z,
        turn[1] * x + turn[4] * y + turn[7] * z,
        turn[2] * x + turn[5] * y + turn[8] * z,
    )


@inline
def _scale(log_scale: np.float32) -> tuple[np.float32, np.float32]:
    """A standard deviation within its bounds, and its derivative by its logarithm."""
    low, high = np.float32(SMALLEST), np.float32(LARGEST)
    scale = np.exp(min(max(log_scale, low), high))
    return scale, scale if low <= log_scale <= high else np.float32(0)


@inline
def _reach(
    quats: Array, log_scales: Array, n: int, axis: Array, v: int, by: np.float32, weight: np.float32, to_quats: Array
) -> Matrix:  # fmt: skip
    """How far a Gaussian reaches along a direction, in units of 1 / `by`: `weight (sqrt(1 + x^2) - 1)`.

    Also its gradient by the logarithms of the scales; that by the quaternion is written.
    """
    one = np.float32(1)
    sa, da = _scale(log_scales[n, 0])
    sb, db = _scale(log_scales[n, 1])
    sc, dc = _scale(log_scales[n, 2])
    w, x, y, z, inverse_length = unit(quats, n)
    a, b, c = _along(rotation(w, x, y, z), axis, v)
    ra, rb, rc = a * sa * by, b * sb * by, c * sc * by
    root = np.sqrt(one + ra * ra + rb * rb + rc * rc)
    pull = weight * by / root
    ra, rb, rc = pull * ra, pull * rb, pull * rc
    to_a, to_b, to_c = ra * a * da, rb * b * db, rc * c * dc
    ra, rb, rc = ra * sa, rb * sb, rc * sc
    ex, ey, ez = axis[v, 0], axis[v, 1], axis[v, 2]
    matrix = (ex * ra, ex * rb, ex * rc, ey * ra, ey * rb, ey * rc, ez * ra, ez * rb, ez * rc)
    to_quats[n, 0], to_quats[n, 1], to_quats[n, 2], to_quats[n, 3] = to_quaternion(
        matrix, w, x, y, z, inverse_length
    )
    return weight * (root - one), to_a, to_b, to_c


@kernel
def _costs(
    means: Array, quats: Array, log_scales: Array, rows: Rows, dressed: Array, axis: Array, ignorance: Array,
    costs: Array, to_means: Array, to_quats: Array, to_log_scales: Array, part: int, parts: int,
) -> None:  # fmt: skip
    one = np.float32(1)
    by_depth, by_extent = np.float32(1 / DEPTH_SCALE), np.float32(1 / EXTENT_SCALE)
    for begin in range(part * BLOCK, len(means), parts * BLOCK):
        for n in range(begin, min(begin + BLOCK, len(means))):
            v = rows[n]
            weight = ignorance[v]
            ex, ey, ez = axis[v, 0], axis[v, 1], axis[v, 2]
            off = (means[n, 0] - dressed[v, 0]) * ex
            off = (off + (means[n, 1] - dressed[v, 1]) * ey + (means[n, 2] - dressed[v, 2]) * ez) * by_depth
            root = np.sqrt(one + off * off)
            costs[0, n] = weight * (root - one)
            pull = weight * by_depth * (off / root)
            to_means[n, 0], to_means[n, 1], to_means[n, 2] = pull * ex, pull * ey, pull * ez
            costs[1, n], to_log_scales[n, 0], to_log_scales[n, 1], to_log_scales[n, 2] = _reach(
                quats, log_scales, n, axis, v, by_extent, weight, to_quats
            )


@kernel
def _tilts(
    quats: Array, log_scales: Array, rows: Rows, normals: Array, ignorance: Array, costs: Array, to_quats: Array,
    part: int, parts: int,
) -> None:  # fmt: skip
    by_tilt = np.float32(1 / TILT_SCALE)
    for begin in range(part * BLOCK, len(quats), parts * BLOCK):
        for n in range(begin, min(begin + BLOCK, len(quats))):
            v = rows[n]
            costs[n], _, _, _ = _reach(quats, log_scales, n, normals, v, by_tilt, ignorance[v], to_quats)


@kernel
def _hold(
    means: Array, quats: Array, log_scales: Array, rows: Rows, vertices: Array, normals: Array, thickness: Array,
    axis: Array, ignorance: Array, sizes: Array, part: int, parts: int,
) -> None:  # fmt: skip
    least = np.float32(LEAST_COSINE)
    for begin in range(part * BLOCK, len(means), parts * BLOCK):
        for n in range(begin, min(begin + BLOCK, len(means))):
            v = rows[n]
            if ignorance[v] < np.float32(HELD_FROM):
                continue
            room = np.float32(1) / ignorance[v]
            nx, ny, nz = normals[v, 0], normals[v, 1], normals[v, 2]
            height = (means[n, 0] - vertices[v, 0]) * nx
            height = height + (means[n, 1] - vertices[v, 1]) * ny + (means[n, 2] - vertices[v, 2]) * nz
            low, high = np.float32(-INWARDS) * room, thickness[v] + np.float32(OUTWARDS) * room
            if height < low or height > high:
                back = min(max(height, low), high) - height
                means[n, 0] += back * nx
                means[n, 1] += back * ny
                means[n, 2] += back * nz
            w, x, y, z, _ = unit(quats, n)
            turn = rotation(w, x, y, z)
            across, along = _along(turn, normals, v), _along(turn, axis, v)
            for k in range(3):
                bound = min(
                    np.float32(THICK) / max(abs(across[k]), least),
                    np.float32(LONG) / max(abs(along[k]), least),
                    np.float32(WIDE) * sizes[v],
                )
                log_scales[n, k] = min(log_scales[n, k], np.log(room * bound))
