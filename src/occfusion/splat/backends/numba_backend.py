"""The `numba` backend: everything on the CPU in compiled loops, float32.

Bitwise the same from run to run and for any number of threads: no two threads write to one place,
and every sum over tiles or Gaussians is formed in an order fixed by the input.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from occfusion.cpu.compilation import run_parts
from occfusion.errors import ConfigError
from occfusion.splat.backends import numba_ahead
from occfusion.splat.backends.layers import Layers
from occfusion.splat.backends.numba_arrays import Inputs, Tape, array_of, inputs_of, working_space
from occfusion.splat.backends.numba_bins import bin_splats, sort_by_depth
from occfusion.splat.backends.numba_blend import blend_part
from occfusion.splat.backends.numba_blocks import GROUP
from occfusion.splat.backends.numba_gradient import COLORS, gaussian_gradients, pair_gradients
from occfusion.splat.backends.numba_layout import SPLAT_SIZE, TILE_HEIGHT, TILE_LANES, TILE_WIDTH
from occfusion.splat.backends.numba_project import project_part
from occfusion.splat.request import Request

LEAST_ALPHA_MIN = 1 / 256
"""The kernels' exponential covers alphas down to this."""


def render(request: Request) -> Layers:
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
    return Layers(*_Rasterize.apply(*gaussians, request.viewmat, request.background, request))


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
    background = np.zeros(3, np.float32) if request.background is None else array_of(request.background)
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
            numba_ahead.start()
        tape, rgb, alpha, depth, radii = _forward(request, inputs_of(request))
        ctx.save_for_backward(*tensors, alpha, depth)
        ctx.tape, ctx.request = tape, request
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        return rgb, alpha, depth, radii

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_rgb, grad_alpha, grad_depth, _):  # type: ignore[no-untyped-def]
        # reading the saved tensors makes autograd complain about any that was changed in between
        alpha, depth = ctx.saved_tensors[-2:]
        tape: Tape = ctx.tape
        needed = ctx.needs_input_grad[:8]
        gradients: list[Tensor | None] = [None] * len(needed)
        if any(needed):
            only_colors = sum(needed) == 1 and needed[COLORS]
            pair_slots = pair_gradients(tape, alpha, depth, (grad_rgb, grad_alpha, grad_depth), only_colors)
            numba_ahead.wait()
            gradients = gaussian_gradients(needed, inputs_of(ctx.request), tape, pair_slots)
        g_background = None
        if ctx.needs_input_grad[8] and grad_rgb is not None:
            g_background = ((1 - alpha)[..., None] * grad_rgb).sum((0, 1))
        return (*gradients, g_background, None)
