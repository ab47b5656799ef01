"""Gradients of the `numba` backend, from those of the picture to those of its inputs."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from occfusion.cpu.compilation import run_parts
from occfusion.splat.backends.numba_arrays import (
    Array,
    Inputs,
    Tape,
    array_of,
    empty_inputs,
    empty_tape,
    working_space,
)
from occfusion.splat.backends.numba_blend_backward import blend_backward_part
from occfusion.splat.backends.numba_blend_colors import blend_colors_backward_part
from occfusion.splat.backends.numba_columns import PART
from occfusion.splat.backends.numba_layout import GRADIENT_SIZE
from occfusion.splat.backends.numba_project_backward import project_backward_part

GRADIENTS = ("means", "quats", "scales", "covariances", "opacities", "colors", "offsets")
COLORS = GRADIENTS.index("colors")


def pair_gradients(
    tape: Tape, alpha: Tensor, depth: Tensor, grads: tuple[Tensor | None, ...], only_colors: bool
) -> Array:
    """Returns the gradient of each (splat, tile) pair `[pairs, 10]`; the colours' columns alone where asked."""
    slots = np.empty((len(tape.entries), GRADIENT_SIZE), np.float32)
    quarters = np.empty((torch.get_num_threads(), 4 * GRADIENT_SIZE), np.float32)
    rgb, *others = array_of(grads[0], 1, 3), array_of(grads[1], 1), array_of(grads[2], 1)
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
    shapes: list[tuple[int, ...]] = [
        inputs.means.shape, inputs.quats.shape, inputs.scales.shape, inputs.covariances.shape,
        inputs.opacities.shape, inputs.colors.shape, inputs.offsets.shape,
    ]  # fmt: skip
    results: list[Tensor | None] = []
    for name, shape, need in zip(GRADIENTS, shapes, needed, strict=False):
        make = torch.empty if name == "colors" else torch.zeros  # colours, the largest, are written in full
        results.append(make(shape) if need else None)
    arrays = [
        array_of(result, *shape[1:]) if result is not None else np.empty((0, *shape[1:]), np.float32)
        for result, shape in zip(results, shapes, strict=True)
    ]
    means, quats, scales, covariances, opacities, colors, offsets = arrays
    camera = np.zeros((-(-len(inputs.means) // PART) if needed[7] else 0, 12))
    run_parts(
        project_backward_part, inputs.means, inputs.quats, inputs.scales, inputs.covariances,
        inputs.opacities, inputs.colors, inputs.camera, inputs.options, inputs.degree,
        tape.splats, tape.slots, pair_slots,
        means, quats, scales, covariances, opacities, colors, offsets, camera, bool(needed[7]),
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


def compile_last() -> None:
    """Compiles what a gradient needs last, or loads it from the cache: by the gradients of no Gaussians."""
    no_pairs = np.empty((0, GRADIENT_SIZE), np.float32)
    gaussian_gradients([True] * (len(GRADIENTS) + 1), empty_inputs(), empty_tape(), no_pairs)
