"""The arrays that go into the `numba` kernels: those of a request, and what the gradient needs of its picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from occfusion.splat.backends.numba_blocks import GROUP_ROWS
from occfusion.splat.backends.numba_layout import SPLAT_SIZE, TILE_LANES, new_planes
from occfusion.splat.limits import FRUSTUM_MARGIN
from occfusion.splat.request import Request

Array = np.ndarray


@dataclass(frozen=True)
class Inputs:
    """The inputs as arrays; what is absent has no rows."""

    means: Array
    quats: Array
    scales: Array
    covariances: Array
    opacities: Array
    colors: Array
    offsets: Array
    camera: Array
    options: Array
    degree: int


@dataclass(frozen=True)
class Tape:
    """What the backward pass needs from the forward pass."""

    splats: Array
    starts: Array
    entries: Array
    slots: Array
    tiles: Array
    grid: Array
    limits: Array
    background: Array
    kept: Array
    blended: Array


def empty_inputs() -> Inputs:
    """Returns the inputs of a picture without Gaussians, each of its type."""
    means, quats, scales, covariances, opacities, colors, offsets = (
        np.empty((0, *tail), np.float32) for tail in ((3,), (4,), (3,), (3, 3), (), (3,), (2,))
    )
    return Inputs(
        means, quats, scales, covariances, opacities, colors, offsets, np.zeros(23), np.zeros(4), degree=0
    )


def empty_tape() -> Tape:
    """Returns the tape of a picture without Gaussians, each array of its type."""
    rows = np.empty((0, SPLAT_SIZE), np.float32)
    return Tape(
        rows,
        starts=np.zeros(1, np.int32),
        entries=np.empty((0, 2), np.int32),
        slots=np.zeros(1, np.int32),
        tiles=np.empty(0, np.int64),
        grid=np.zeros(3, np.int64),
        limits=np.zeros(3, np.float32),
        background=np.zeros(3, np.float32),
        kept=np.empty((0, 2, TILE_LANES), np.float32),
        blended=np.empty(0, np.uint32),
    )  # fmt: skip


def working_space() -> tuple[Array, Array]:
    """Returns planes and groups of splats (`numba_blocks`) for every thread; made here, for kernels compile longer."""
    threads = torch.get_num_threads()
    return np.tile(new_planes(), (threads, 1)), np.zeros((threads, GROUP_ROWS, SPLAT_SIZE), np.float32)


def array_of(tensor: Tensor | None, *tail: int) -> Array:
    """Returns the tensor's memory as an array, without rows when there is none."""
    if tensor is None:
        return np.empty((0, *tail), np.float32)
    array: Array = tensor.detach().contiguous().numpy()
    return array


def inputs_of(request: Request) -> Inputs:
    """Returns a request's inputs; memory is shared where it lies in one piece."""
    limits = request.limits
    return Inputs(
        means=array_of(request.means),
        quats=array_of(request.quats, 4),
        scales=array_of(request.scales, 3),
        covariances=array_of(request.covariances, 3, 3),
        opacities=array_of(request.opacities),
        colors=array_of(request.colors.flatten(1)),
        offsets=array_of(request.screen_offsets, 2),
        camera=pack_camera(request),
        options=np.array([request.near, limits.dilation, limits.alpha_min, request.antialiased]),
        degree=-1 if request.sh_degree is None else request.sh_degree,
    )


def pack_camera(request: Request) -> Array:
    """Returns the camera as 23 numbers, float64.

    0-8 rotation row by row, 9-11 translation, 12-15 fx fy cx cy, 16-19 the range of x/z and of y/z
    in which the projection is linearised, 20-22 the centre.
    """
    fx, fy, cx, cy = request.intrinsics
    view = request.viewmat.detach().double().cpu().numpy()
    rotation, translation = view[:3, :3], view[:3, 3]
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * request.width / fx, FRUSTUM_MARGIN * 0.5 * request.height / fy
    slopes = [
        -cx / fx - margin_x, (request.width - cx) / fx + margin_x,
        -cy / fy - margin_y, (request.height - cy) / fy + margin_y,
    ]  # fmt: skip
    parts = [rotation.ravel(), translation, [fx, fy, cx, cy], slopes, -rotation.T @ translation]
    return np.concatenate(parts).astype(np.float64)
