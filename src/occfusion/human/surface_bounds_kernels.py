"""`surface_bounds` Gaussian by Gaussian."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.cpu.compilation import array_of, inline, kernel, run_parts
from occfusion.geometry.quaternion_kernels import Array, Matrix, rotation, unit
from occfusion.human.gaussians import Gaussians
from occfusion.human.surface_bounds import (
    HELD_FROM,
    INWARDS,
    LEAST_COSINE,
    LONG,
    OUTWARDS,
    THICK,
    WIDE,
    KnownSurface,
)

Rows = NDArray[np.int64]
BLOCK = 1024
"""Gaussians that a thread takes at a time."""


def hold(gaussians: Gaussians, surface: KnownSurface) -> None:
    """As `surface_bounds.hold`, but for the count of changes of the parameters."""
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
    hold(gaussians, KnownSurface(points, points, values, points, values, values))


@inline
def _along(turn: Matrix, axis: Array, v: int) -> tuple[np.float32, np.float32, np.float32]:
    """A direction in the axes of a Gaussian."""
    x, y, z = axis[v, 0], axis[v, 1], axis[v, 2]
    return (
        turn[0] * x + turn[3] * y + turn[6] * z,
        turn[1] * x + turn[4] * y + turn[7] * z,
        turn[2] * x + turn[5] * y + turn[8] * z,
    )


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
