"""L1 and SSIM of one picture in one pass with the gradient written out: what `losses.l1` and `losses.ssim_loss` give.

Those two are the specification, and the tests hold this to them. On a CPU they cost a fifth of a training step: a dozen
passes of autograd over the crop, and blurs as convolutions of many planes. Here each channel is one plane in the cache.
The numbers are in `docs/reference/bench.md`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from occfusion.cpu.compilation import array_of, inline, kernel, run_parts
from occfusion.quality.ssim import C1, C2, WINDOW, window

Plane = NDArray[np.float32]
HALF = WINDOW // 2
STATISTICS = 2
"""Sums of a channel: of absolute differences, and of 1 - SSIM."""


def l1_and_ssim(a: Tensor, b: Tensor, mask: Tensor, inner: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the mean absolute difference and the mean of 1 - SSIM over the pixels of masks and all channels.

    Pixels outside of both masks count for neither. Only `a` gets a gradient.

    Args:
        a: `[H, W, C]`, 0..1, float32 on a CPU.
        b: the same shape.
        mask: of the first, bool `[H, W]`.
        inner: of SSIM, whose windows see what is outside of it as black, bool `[H, W]`.
    """
    both: tuple[Tensor, Tensor] = _L1AndSsim.apply(a, b, mask, inner)
    return both


def warm_up() -> None:
    """Compiles the kernel, or loads it from the cache: by two tiny pictures."""
    shown, wanted = torch.zeros(2, 2, 2, 3)
    whole = torch.ones(2, 2, dtype=torch.bool)
    torch.autograd.backward(l1_and_ssim(shown.requires_grad_(), wanted, whole, whole))


class _L1AndSsim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor, mask: Tensor, inner: Tensor) -> tuple[Tensor, Tensor]:
        height, width, channels = a.shape
        needed = bool(ctx.needs_input_grad[0])
        by_l1, by_ssim = (np.empty(a.shape if needed else (0, 0, 0), np.float32) for _ in range(2))
        sums = np.zeros((channels, STATISTICS))
        if a.numel():
            run_parts(
                _channels, *(array_of(part) for part in (a, b, mask, inner)),
                *(_padded(window(length)) for length in (height, width)), sums, by_l1, by_ssim, needed,
            )  # fmt: skip
        counts = [max(int(pixels.sum()) * channels, 1) for pixels in (mask, inner)]
        if needed:
            ctx.save_for_backward(torch.from_numpy(by_l1), torch.from_numpy(by_ssim))
        ctx.counts = counts
        l1, ssim = (sums.sum(axis=0) / counts).tolist()
        return a.new_tensor(l1), a.new_tensor(ssim)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, for_l1: Tensor, for_ssim: Tensor) -> tuple[Tensor, None, None, None]:
        by_l1, by_ssim = ctx.saved_tensors
        of_l1, of_ssim = ctx.counts
        total = by_l1.mul_(for_l1 / of_l1)
        return total.add_(by_ssim * (for_ssim / of_ssim)), None, None, None


def _padded(weights: NDArray[np.float64]) -> Plane:
    """Returns a window of full width: zeros on both sides of what an axis shorter than that has."""
    missing = HALF - len(weights) // 2
    return np.pad(weights, missing).astype(np.float32)


@inline
def _down(plane: Plane, weights: Plane, top: int, out: Plane) -> None:
    """One row of a plane blurred along its columns; the window starts at row `top`."""
    for x in range(plane.shape[1]):
        total = np.float32(0)
        for k in range(WINDOW):
            total += weights[k] * plane[top + k, x]
        out[x] = total


@inline
def _across(row: Plane, weights: Plane, out: Plane) -> None:
    """A row blurred along itself."""
    for x in range(len(out)):
        total = np.float32(0)
        for k in range(WINDOW):
            total += weights[k] * row[x + k]
        out[x] = total


@kernel
def _channels(
    a: Plane,
    b: Plane,
    mask: NDArray[np.bool_],
    inner: NDArray[np.bool_],
    rows: Plane,
    columns: Plane,
    sums: NDArray[np.float64],
    by_l1: Plane,
    by_ssim: Plane,
    needed: bool,
    part: int,
    parts: int,
) -> None:
    """Every `parts`-th channel: its sums, and the derivatives of these by `a` where they are needed."""
    height, width, channels = a.shape
    reach_y, reach_x = min(HALF, (height - 1) // 2), min(HALF, (width - 1) // 2)
    wide, high = width + 2 * HALF, height + 2 * HALF
    # sum, difference and their squares; borders are mirrored as far as the window reaches
    planes = np.zeros((4, high, wide), np.float32)
    blurred = np.zeros(wide + 2 * HALF, np.float32)
    moments = np.empty((4, width), np.float32)
    by_moments = np.zeros((3, height, wide + 2 * HALF), np.float32)
    spread = np.empty((3, high, wide), np.float32)
    for channel in range(part, channels, parts):
        for y in range(height):
            for x in range(width):
                p, q = a[y, x, channel], b[y, x, channel]
                difference = p - q if mask[y, x] else np.float32(0)
                sums[channel, 0] += abs(difference)
                if needed:
                    by_l1[y, x, channel] = np.sign(difference)
                total, difference = np.float32(0), np.float32(0)
                if inner[y, x]:
                    total, difference = p + q, p - q
                planes[0, y + HALF, x + HALF] = total
                planes[1, y + HALF, x + HALF] = difference
                planes[2, y + HALF, x + HALF] = total * total
                planes[3, y + HALF, x + HALF] = difference * difference
        for plane in planes:
            for y in range(HALF, HALF + height):
                for k in range(1, reach_x + 1):
                    plane[y, HALF - k] = plane[y, HALF + k]
                    plane[y, HALF + width - 1 + k] = plane[y, HALF + width - 1 - k]
            for k in range(1, reach_y + 1):  # number by number: a row at once compiles for seconds
                for x in range(wide):
                    plane[HALF - k, x] = plane[HALF + k, x]
                    plane[HALF + height - 1 + k, x] = plane[HALF + height - 1 - k, x]
        by_moments[:] = 0
        for y in range(height):
            if not inner[y].any():
                continue
            for j in range(4):
                _down(planes[j], rows, y, blurred)
                _across(blurred, columns, moments[j])
            for x in range(width):
                if not inner[y, x]:
                    continue
                mean_total, mean_difference = moments[0, x], moments[1, x]
                total2, difference2 = mean_total * mean_total, mean_difference * mean_difference
                var_total, var_difference = moments[2, x] - total2, moments[3, x] - difference2
                a1 = (total2 - difference2) / np.float32(2) + np.float32(C1)
                b1 = (total2 + difference2) / np.float32(2) + np.float32(C1)
                a2 = (var_total - var_difference) / np.float32(2) + np.float32(C2)
                b2 = (var_total + var_difference) / np.float32(2) + np.float32(C2)
                scaled = np.float32(1) / (b1 * b2)
                value = a1 * a2 * scaled
                sums[channel, 1] += np.float32(1) - value
                if needed:
                    by_a1, by_a2 = -scaled * a2, -scaled * a1
                    by_b1, by_b2 = value / b1, value / b2
                    at = x + 2 * HALF
                    by_moments[0, y, at] = mean_total * (by_a1 + by_b1 - by_a2 - by_b2) + (
                        mean_difference * (by_b1 - by_a1 + by_a2 - by_b2)
                    )
                    by_moments[1, y, at] = (by_a2 + by_b2) / np.float32(2)
                    by_moments[2, y, at] = (by_b2 - by_a2) / np.float32(2)
        if not needed:
            continue
        # the transpose of the blur: spread everywhere, then fold what fell on the mirrored border back
        spread[:] = 0
        for y in range(height):
            if not inner[y].any():
                continue
            for j in range(3):
                row = blurred[:wide]
                _across(by_moments[j, y], columns, row)
                for k in range(1, reach_x + 1):
                    row[HALF + k] += row[HALF - k]
                    row[HALF + width - 1 - k] += row[HALF + width - 1 + k]
                for k in range(WINDOW):
                    for x in range(wide):
                        spread[j, y + k, x] += rows[k] * row[x]
        for j in range(3):
            for k in range(1, reach_y + 1):
                for x in range(wide):
                    spread[j, HALF + k, x] += spread[j, HALF - k, x]
                    spread[j, HALF + height - 1 - k, x] += spread[j, HALF + height - 1 + k, x]
        for y in range(height):
            for x in range(width):
                v, u = y + HALF, x + HALF
                gradient = spread[0, v, u] + np.float32(2) * (
                    planes[0, v, u] * spread[1, v, u] + planes[1, v, u] * spread[2, v, u]
                )
                by_ssim[y, x, channel] = gradient if inner[y, x] else np.float32(0)
