"""`shading.posed_colors` Gaussian by Gaussian, with the gradient written out; bands 0 and 1."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from occfusion.cpu.compilation import array_of, inline, kernel, run_parts
from occfusion.human.shading import HIGHEST_COMPILED, SHORTEST, TOUCHING
from occfusion.splat.harmonics import COLOR_OFFSET, SH_C0, SH_C1

Array = NDArray[np.float32]
BLOCK = 1024
"""Gaussians that a thread takes at a time."""


class PosedColors(torch.autograd.Function):
    """Colours of posed Gaussians, for float32 on a CPU."""

    @staticmethod
    def forward(
        ctx: Any,
        sh0: Tensor,
        sh_rest: Tensor,
        means: Tensor,
        linear: Tensor,
        camera_centre: Tensor,
        normals: Tensor,
        rows: Tensor,
        key_light: Tensor,
        degree: int,
    ) -> Tensor:
        """Returns colours `[N, 3]`; arguments as `shading.posed_colors`, an empty lamp for even light."""
        count = len(sh0)
        colors, shades = torch.empty(count, 3), torch.empty(count)
        inputs = (sh0, sh_rest, means, linear, camera_centre)
        run_parts(
            _forward, *map(array_of, inputs), array_of(normals), rows.numpy(), array_of(key_light), degree,
            colors.numpy(), shades.numpy(),
        )  # fmt: skip
        ctx.save_for_backward(*inputs, colors, shades)
        ctx.degree = degree
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Returns the gradients; of band 0 alone there is none by place and turn."""
        *inputs, colors, shades = ctx.saved_tensors
        sh0, sh_rest, means, linear, _ = inputs
        degree: int = ctx.degree
        to_sh0, to_rest = torch.empty(sh0.shape), torch.zeros(sh_rest.shape if degree else (0, 0, 3))
        to_means = torch.empty(means.shape if degree else (0, 3))
        to_linear = torch.empty(linear.shape if degree else (3, 3, 0))
        run_parts(
            _backward, *map(array_of, inputs), colors.numpy(), shades.numpy(), array_of(gradient), degree,
            *(tensor.numpy() for tensor in (to_sh0, to_rest, to_means, to_linear)),
        )  # fmt: skip
        found: list[Tensor | None] = [to_sh0, to_rest, to_means, to_linear]
        return (*(found if degree else [to_sh0, None, None, None]), *[None] * 5)


def warm_up() -> None:
    """Compiles the kernels, or loads them from the cache: by the colours of no Gaussian."""
    empty = [torch.zeros(shape) for shape in ((0, 1, 3), (0, 3, 3), (0, 3), (3, 3, 0))]
    none = torch.zeros(0, dtype=torch.int64)
    colors = PosedColors.apply(
        empty[0].requires_grad_(),
        *empty[1:],
        torch.zeros(3),
        empty[2],
        none,
        torch.zeros(0),
        HIGHEST_COMPILED,
    )
    colors.sum().backward()


@inline
def _direction(
    means: Array, linear: Array, centre: Array, n: int
) -> tuple[np.float32, np.float32, np.float32, np.float32, bool]:
    """The unit direction that a Gaussian is seen along, turned back with it; 1 / length; whether that is bounded."""
    x, y, z = means[n, 0] - centre[0], means[n, 1] - centre[1], means[n, 2] - centre[2]
    a = linear[0, 0, n] * x + linear[1, 0, n] * y + linear[2, 0, n] * z
    b = linear[0, 1, n] * x + linear[1, 1, n] * y + linear[2, 1, n] * z
    c = linear[0, 2, n] * x + linear[1, 2, n] * y + linear[2, 2, n] * z
    squared = a * a + b * b + c * c
    least = np.float32(TOUCHING * TOUCHING)
    bounded = squared < least
    inverse = np.float32(1) / np.sqrt(max(squared, least))
    return a * inverse, b * inverse, c * inverse, inverse, bounded


@kernel
def _forward(
    sh0: Array,
    sh_rest: Array,
    means: Array,
    linear: Array,
    centre: Array,
    normals: Array,
    rows: NDArray[np.int64],
    key_light: Array,
    degree: int,
    colors: Array,
    shades: Array,
    part: int,
    parts: int,
) -> None:
    one = np.float32(1)
    is_lit = len(key_light) == 3
    even = one
    if is_lit:
        strength = np.sqrt(key_light[0] ** 2 + key_light[1] ** 2 + key_light[2] ** 2)
        even = one / (one + np.float32(0.25) * strength)
    for begin in range(part * BLOCK, len(sh0), parts * BLOCK):
        for n in range(begin, min(begin + BLOCK, len(sh0))):
            shade = one
            if is_lit:
                row = rows[n]
                p, q, r = normals[row, 0], normals[row, 1], normals[row, 2]
                a = linear[0, 0, n] * p + linear[0, 1, n] * q + linear[0, 2, n] * r
                b = linear[1, 0, n] * p + linear[1, 1, n] * q + linear[1, 2, n] * r
                c = linear[2, 0, n] * p + linear[2, 1, n] * q + linear[2, 2, n] * r
                length = max(np.sqrt(a * a + b * b + c * c), np.float32(SHORTEST))
                facing = (key_light[0] * a + key_light[1] * b + key_light[2] * c) / length
                # written so that what is not a number goes on, and shows
                shade = even if facing < np.float32(0) else (one + facing) * even
            shades[n] = shade
            x = y = z = np.float32(0)
            if degree:
                x, y, z, _, _ = _direction(means, linear, centre, n)
            for k in range(3):
                value = np.float32(COLOR_OFFSET) + np.float32(SH_C0) * sh0[n, 0, k]
                if degree:
                    value += np.float32(SH_C1) * (
                        z * sh_rest[n, 1, k] - y * sh_rest[n, 0, k] - x * sh_rest[n, 2, k]
                    )
                # below 0 without gradient, and told from 0 itself by the sign
                colors[n, k] = np.float32(-0.0) if value < np.float32(0) else value * shade


@kernel
def _backward(
    sh0: Array,
    sh_rest: Array,
    means: Array,
    linear: Array,
    centre: Array,
    colors: Array,
    shades: Array,
    gradient: Array,
    degree: int,
    to_sh0: Array,
    to_rest: Array,
    to_means: Array,
    to_linear: Array,
    part: int,
    parts: int,
) -> None:
    c1 = np.float32(SH_C1)
    for begin in range(part * BLOCK, len(sh0), parts * BLOCK):
        for n in range(begin, min(begin + BLOCK, len(sh0))):
            x = y = z = inverse = np.float32(0)
            bounded = False
            if degree:
                x, y, z, inverse, bounded = _direction(means, linear, centre, n)
            by_x = by_y = by_z = np.float32(0)
            for k in range(3):
                own = gradient[n, k] * shades[n]
                if np.signbit(colors[n, k]):
                    own = np.float32(0)
                to_sh0[n, 0, k] = np.float32(SH_C0) * own
                if degree:
                    own *= c1
                    to_rest[n, 0, k], to_rest[n, 1, k], to_rest[n, 2, k] = -y * own, z * own, -x * own
                    by_y -= own * sh_rest[n, 0, k]
                    by_z += own * sh_rest[n, 1, k]
                    by_x -= own * sh_rest[n, 2, k]
            if degree:
                if not bounded:
                    along = x * by_x + y * by_y + z * by_z
                    by_x, by_y, by_z = by_x - x * along, by_y - y * along, by_z - z * along
                by_x, by_y, by_z = by_x * inverse, by_y * inverse, by_z * inverse
                for j in range(3):
                    apart = means[n, j] - centre[j]
                    to_means[n, j] = linear[j, 0, n] * by_x + linear[j, 1, n] * by_y + linear[j, 2, n] * by_z
                    to_linear[j, 0, n] = apart * by_x
                    to_linear[j, 1, n] = apart * by_y
                    to_linear[j, 2, n] = apart * by_z
