"""Structural similarity as a map, with an analytic backward; the definition is in `docs/reference/metrics.md`."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

WINDOW = 11
"""Width of the Gaussian window in pixels (Wang et al., 2004)."""
SIGMA = 1.5
"""Standard deviation of the window in pixels (Wang et al., 2004)."""
C1 = 0.01**2
"""Stabiliser of the luminance term for data in 0..1: (K1 L)^2 with K1 = 0.01, L = 1."""
C2 = 0.03**2
"""Stabiliser of the contrast-structure term for data in 0..1: (K2 L)^2 with K2 = 0.03, L = 1."""


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Returns the structural similarity of two pictures around each pixel and channel, `[H, W, C]`.

    Gaussian window of 11 px and sigma 1.5, population covariance, data range 1, borders mirrored without
    repeating the edge pixel: torchmetrics' and kornia's definition. scikit-image
    (`gaussian_weights=True, use_sample_covariance=False`) agrees wherever the window lies inside the picture.
    Along an axis shorter than 11 px the window is the largest odd width that fits, renormalised.

    The four moments are those of a+b and a-b, not the usual five of a, b, a², b² and ab: one blur less, and
    equal pictures give exactly 1. The float32 error is largest where both pictures are bright and flat: there
    variances of the size of C2 are differences of numbers near 4: 3e-4 in the map
    at worst, where the five usual moments give 2e-3.

    Args:
        a: a picture in 0..1, `[H, W, C]`.
        b: the other, of the same shape and type.

    Raises:
        ValueError: the shapes differ or are not `[H, W, C]`.
    """
    if a.shape != b.shape or a.dim() != 3:
        found = f"{list(a.shape)} and {list(b.shape)}"
        raise ValueError(f"ssim_map needs two pictures [H, W, C] of one size, got {found}")
    if a.numel() == 0:
        return (a + b) * 0.0
    planes: Tensor = _SsimMap.apply(a.permute(2, 0, 1), b.permute(2, 0, 1))
    return planes.permute(1, 2, 0)


class _SsimMap(torch.autograd.Function):
    """The map of `[C, H, W]` pictures from the moments of their sum and difference: one blur each way."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        total, difference = (a + b).contiguous(), (a - b).contiguous()
        moments = _blur(torch.cat([total, difference, total * total, difference * difference]))
        ctx.save_for_backward(total, difference, moments)
        a1, b1, a2, b2 = _terms(moments)
        return (a1 * a2) / (b1 * b2)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        total, difference, moments = ctx.saved_tensors
        mean_total, mean_difference = moments.chunk(4)[:2]
        a1, b1, a2, b2 = _terms(moments)
        scaled = grad.contiguous() / (b1 * b2)
        by_a1, by_a2 = scaled * a2, scaled * a1
        value = by_a2 * a2  # gradient x map
        by_b1, by_b2 = -value / b1, -value / b2
        by_moments = torch.cat(
            [
                mean_total * (by_a1 + by_b1 - by_a2 - by_b2),
                mean_difference * (by_b1 - by_a1 + by_a2 - by_b2),
                (by_a2 + by_b2) / 2,
                (by_b2 - by_a2) / 2,
            ]
        )
        d_total, d_difference, d_total2, d_difference2 = _blur_adjoint(by_moments).chunk(4)
        d_total = d_total + 2 * total * d_total2
        d_difference = d_difference + 2 * difference * d_difference2
        needs_a, needs_b = ctx.needs_input_grad
        return d_total + d_difference if needs_a else None, d_total - d_difference if needs_b else None


def _terms(moments: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns the numerators and denominators of the luminance and of the contrast-structure term.

    With S, D the means of a+b and a-b: 2 mu_a mu_b = (S² - D²)/2 and mu_a² + mu_b² = (S² + D²)/2, and the
    same with variances for the covariance and the sum of variances.
    """
    mean_total, mean_difference, square_total, square_difference = moments.chunk(4)
    total2, difference2 = mean_total * mean_total, mean_difference * mean_difference
    var_total, var_difference = square_total - total2, square_difference - difference2
    return (
        (total2 - difference2) / 2 + C1,
        (total2 + difference2) / 2 + C1,
        (var_total - var_difference) / 2 + C2,
        (var_total + var_difference) / 2 + C2,
    )


def window(length: int) -> NDArray[np.float64]:
    """Returns the normalised window for an axis of `length` pixels."""
    width = min(WINDOW, length - 1 + length % 2)
    half = width // 2
    weights = [math.exp(-((i - half) ** 2) / (2 * SIGMA**2)) for i in range(width)]
    return np.array([w / math.fsum(weights) for w in weights])


def _kernel(length: int, like: Tensor) -> Tensor:
    return _window_on(min(length, WINDOW + 1), like.dtype, like.device)


@lru_cache(maxsize=64)
def _window_on(length: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # kept: also for steps that have gradients
        return torch.from_numpy(window(length)).to(device, dtype)


def _blur(planes: Tensor) -> Tensor:
    """Returns `[P, H, W]` blurred along both image axes with mirrored borders."""
    rows, columns = _kernel(planes.shape[1], planes), _kernel(planes.shape[2], planes)
    half_r, half_c = len(rows) // 2, len(columns) // 2
    padded = F.pad(planes[None], (half_c, half_c, half_r, half_r), mode="reflect")
    return _correlate(padded, rows, columns, 0, 0)


def _blur_adjoint(grad: Tensor) -> Tensor:
    """Returns the transpose of `_blur` on `[P, H, W]`: correlate everywhere, then fold the mirror back."""
    rows, columns = _kernel(grad.shape[1], grad), _kernel(grad.shape[2], grad)
    padded = _correlate(grad[None], rows, columns, len(rows) - 1, len(columns) - 1)
    return _fold(_fold(padded, 1, len(rows) // 2), 2, len(columns) // 2)


def _correlate(planes: Tensor, rows: Tensor, columns: Tensor, pad_rows: int, pad_columns: int) -> Tensor:
    """Returns `[1, P, H, W]` correlated with the two windows over zero padding, `[P, H', W']` contiguous."""
    count = planes.shape[1]
    # depthwise convolution on a CPU is several times faster with the planes innermost
    planes = planes.contiguous(memory_format=torch.channels_last)
    weight = rows.view(1, 1, -1, 1).expand(count, 1, -1, 1)
    planes = F.conv2d(planes, weight, padding=(pad_rows, 0), groups=count)
    weight = columns.view(1, 1, 1, -1).expand(count, 1, 1, -1)
    return F.conv2d(planes, weight, padding=(0, pad_columns), groups=count)[0].contiguous()


def _fold(x: Tensor, dim: int, half: int) -> Tensor:
    """Returns `x` without `half` border pixels on both ends of `dim`, each added to the pixel it mirrored."""
    if half == 0:
        return x
    length = x.shape[dim] - 2 * half
    inner = x.narrow(dim, half, length).clone()
    inner.narrow(dim, 1, half).add_(x.narrow(dim, 0, half).flip(dim))
    inner.narrow(dim, length - 1 - half, half).add_(x.narrow(dim, half + length, half).flip(dim))
    return inner
