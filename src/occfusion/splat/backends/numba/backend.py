"""From a request to arrays, kernels and their gradients.

Bitwise the same from run to run and for any number of threads: no two threads write to one place, and every sum over
tiles or Gaussians is formed in an order fixed by the input.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from occfusion.cpu.compilation import array_of, run_parts
from occfusion.errors import ConfigError
from occfusion.splat.backends.numba import ahead
from occfusion.splat.backends.numba.bins import GROUP, GROUP_ROWS, bin_splats, sort_by_depth
from occfusion.splat.backends.numba.blend import blend_part
from occfusion.splat.backends.numba.blend_backward import blend_backward_part, blend_colors_backward_part
from occfusion.splat.backends.numba.columns import PART
from occfusion.splat.backends.numba.layout import (
    GRADIENT_SIZE,
    SPLAT_SIZE,
    TILE_HEIGHT,
    TILE_LANES,
    TILE_WIDTH,
    new_planes,
)
from occfusion.splat.backends.numba.project import project_backward_part, project_part
from occfusion.splat.limits import FRUSTUM_MARGIN
from occfusion.splat.once import differentiable_once
from occfusion.splat.request import Request
from occfusion.types import Rendering

Array = np.ndarray


@dataclass(frozen=True)
class Inputs:
    """The inputs as arrays. Shapes that are absent are None; absent offsets have no rows."""

    means: Array
    quats: Array | None
    scales: Array | None
    covariances: Array | None
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


def working_space() -> tuple[Array, Array]:
    """Returns planes and groups of splats (`bins`) for every thread; made here, for kernels compile longer."""
    threads = torch.get_num_threads()
    return np.tile(new_planes(), (threads, 1)), np.zeros((threads, GROUP_ROWS, SPLAT_SIZE), np.float32)


def rows_of(tensor: Tensor | None, *tail: int) -> Array:
    """Returns the tensor's memory as an array, without rows when there is none."""
    return np.empty((0, *tail), np.float32) if tensor is None else array_of(tensor)


def shape_of(tensor: Tensor | None) -> Array | None:
    """Returns the tensor's memory as an array, None when there is none: then nothing is compiled for it."""
    return None if tensor is None else array_of(tensor)


def inputs_of(request: Request) -> Inputs:
    """Returns a request's inputs; memory is shared where it lies in one piece."""
    limits = request.limits
    return Inputs(
        means=rows_of(request.means),
        quats=shape_of(request.quats),
        scales=shape_of(request.scales),
        covariances=shape_of(request.covariances),
        opacities=rows_of(request.opacities),
        colors=rows_of(request.colors.flatten(1)),
        offsets=rows_of(request.screen_offsets, 2),
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


GRADIENTS = ("means", "quats", "scales", "covariances", "opacities", "colors", "offsets")
NO_ROWS: dict[str, tuple[int, ...]] = {"quats": (0, 4), "scales": (0, 3), "covariances": (0, 3, 3)}
COLORS = GRADIENTS.index("colors")


def pair_gradients(
    tape: Tape, alpha: Tensor, depth: Tensor, grads: tuple[Tensor | None, ...], only_colors: bool
) -> Array:
    """Returns the gradient of each (splat, tile) pair `[pairs, 10]`; the colours' columns alone where asked."""
    slots = np.empty((len(tape.entries), GRADIENT_SIZE), np.float32)
    quarters = np.empty((torch.get_num_threads(), 4 * GRADIENT_SIZE), np.float32)
    rgb, *others = rows_of(grads[0], 1, 3), rows_of(grads[1], 1), rows_of(grads[2], 1)
    scene = (
        tape.splats, tape.starts, tape.entries, tape.tiles, *working_space(), quarters, tape.grid, tape.limits,
        tape.background, alpha.numpy(), depth.numpy(), tape.blended, tape.kept,
    )  # fmt: skip
    if only_colors:
        run_parts(blend_colors_backward_part, *scene, rgb, slots)
    else:
        run_parts(blend_backward_part, *scene, rgb, *others, slots)
    return slots


def gaussian_gradients(needed: Any, inputs: Inputs, tape: Tape, pair_slots: Array) -> list[Tensor | None]:
    """Returns the gradients of the eight inputs from means to viewmat; None for those not needed."""
    given = [getattr(inputs, name) for name in GRADIENTS]
    shapes = [NO_ROWS[name] if a is None else a.shape for name, a in zip(GRADIENTS, given, strict=True)]
    results: list[Tensor | None] = []
    for name, shape, need in zip(GRADIENTS, shapes, needed, strict=False):
        make = torch.empty if name == "colors" else torch.zeros  # colours, the largest, are written in full
        results.append(make(shape) if need else None)
    arrays = [rows_of(result, *shape[1:]) for result, shape in zip(results, shapes, strict=True)]
    camera = np.zeros((-(-len(inputs.means) // PART) if needed[7] else 0, 12))
    run_parts(
        project_backward_part, inputs.means, inputs.quats, inputs.scales, inputs.covariances,
        inputs.opacities, inputs.colors, inputs.camera, inputs.options, inputs.degree,
        tape.splats, tape.slots, pair_slots, *arrays, camera, bool(needed[7]),
    )  # fmt: skip
    color = results[COLORS]
    if color is not None and inputs.degree >= 0:
        results[COLORS] = color.unflatten(1, (-1, 3))
    viewmat = None
    if needed[7]:
        total = torch.from_numpy(camera.sum(0)).float()
        viewmat = torch.zeros(4, 4)
        viewmat[:3, :3], viewmat[:3, 3] = total[:9].view(3, 3), total[9:]
    return [*results, viewmat]


LEAST_ALPHA_MIN = 1 / 256
"""The kernels' exponential covers alphas down to this."""


def render(request: Request) -> Rendering:
    """Returns the crop of the picture; the backward pass is compiled too.

    Raises:
        ConfigError: input is not float32 on a CPU, or a cut-off is out of range.
    """
    means = request.means
    if means.dtype != torch.float32 or means.device.type != "cpu":
        raise ConfigError(
            f"rasterizer backend 'numba' takes float32 on a CPU, got {means.dtype} on {means.device}"
        )
    if request.limits.alpha_min < LEAST_ALPHA_MIN:
        raise ConfigError(
            f"rasterizer backend 'numba' needs alpha_min >= 1/256, got {request.limits.alpha_min}"
        )
    gaussians = (
        means, request.quats, request.scales, request.covariances, request.opacities, request.colors,
        request.screen_offsets,
    )  # fmt: skip
    return Rendering(*_Rasterize.apply(*gaussians, request.viewmat, request.background, request))


def _forward(request: Request, inputs: Inputs) -> tuple[Tape, Tensor, Tensor, Tensor, Tensor]:
    n = len(inputs.means)
    x, y, width, height = request.crop
    window = np.array([x + 0.5, x + width - 0.5, y + 0.5, y + height - 0.5])
    radii = torch.zeros(n, 2)
    splats = np.empty((n, SPLAT_SIZE), np.float32)
    run_parts(
        project_part, inputs.means, inputs.quats, inputs.scales, inputs.covariances, inputs.opacities,
        inputs.colors, inputs.offsets, inputs.camera, window, inputs.options, inputs.degree, splats,
        radii.numpy(),
    )  # fmt: skip
    order = sort_by_depth(splats, inputs.means, inputs.camera)
    across, down = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    starts, entries, slots = bin_splats(splats, order, x, y, across, down)
    lengths = np.diff(starts)
    # longest lists first, so that dealing the tiles out in turn gives each thread a like share
    tiles = np.argsort(-lengths, kind="stable")[: np.count_nonzero(lengths)]
    background = np.zeros(3, np.float32) if request.background is None else rows_of(request.background)
    limits = request.limits
    tape = Tape(
        splats, starts, entries, slots, tiles,
        grid=np.array([x, y, across]),
        limits=np.array([limits.alpha_max, limits.alpha_min, limits.stop], np.float32),
        background=background,
        kept=np.empty((len(tiles), 2, TILE_LANES), np.float32),
        blended=np.empty(len(entries), np.uint32),
    )  # fmt: skip
    if request.background is None:
        rgb = torch.zeros(height, width, 3)
    else:
        rgb = request.background.detach().repeat(height, width, 1)
    alpha, depth = torch.zeros(height, width), torch.zeros(height, width)
    reached = np.empty((torch.get_num_threads(), GROUP), np.int32)
    run_parts(
        blend_part, splats, starts, entries, tiles, *working_space(), reached, tape.grid, tape.limits,
        background, rgb.numpy(), alpha.numpy(), depth.numpy(), tape.kept, tape.blended,
    )  # fmt: skip
    return tape, rgb, alpha, depth, radii


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *inputs):  # type: ignore[no-untyped-def]
        *tensors, request = inputs
        if any(ctx.needs_input_grad):
            ahead.start(ahead.PROGRAM.format(of_covariances=request.covariances is not None))
        tape, rgb, alpha, depth, radii = _forward(request, inputs_of(request))
        ctx.save_for_backward(*tensors, alpha, depth)
        ctx.tape, ctx.request = tape, request
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        return rgb, alpha, depth, radii

    @staticmethod
    @differentiable_once
    def backward(ctx, grad_rgb, grad_alpha, grad_depth, _):  # type: ignore[no-untyped-def]
        # reading the saved tensors makes autograd complain about any that was changed in between
        alpha, depth = ctx.saved_tensors[-2:]
        tape: Tape = ctx.tape
        needed = ctx.needs_input_grad[:8]
        gradients: list[Tensor | None] = [None] * len(needed)
        if any(needed):
            only_colors = sum(needed) == 1 and needed[COLORS]
            pair_slots = pair_gradients(tape, alpha, depth, (grad_rgb, grad_alpha, grad_depth), only_colors)
            ahead.wait()
            gradients = gaussian_gradients(needed, inputs_of(ctx.request), tape, pair_slots)
        g_background = None
        if ctx.needs_input_grad[8] and grad_rgb is not None:
            g_background = ((1 - alpha)[..., None] * grad_rgb).sum((0, 1))
        return (*gradients, g_background, None)
