"""The photometric loss terms of one picture; each is 0, gradient too, where there is nothing to compare."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from occfusion.gpu.graphs import is_recording
from occfusion.quality.ssim import WINDOW, ssim_map


def l1(a: Tensor, b: Tensor, mask: Tensor | None = None) -> Tensor:
    """Returns the mean absolute difference over the pixels of `mask` and all channels, a scalar.

    The paper's first term of L_photo (§4.2), with M as the mask.

    Args:
        a: `[H, W, C]` or `[H, W]`.
        b: the same shape.
        mask: bool `[H, W]`; all pixels when None.
    """
    _check_shapes(a, b, mask)
    return masked_mean(_difference(a, b, mask).abs(), mask)


def l2(a: Tensor, b: Tensor, mask: Tensor | None = None, weights: Tensor | None = None) -> Tensor:
    """Returns the mean squared difference over the pixels of `mask` and all channels, a scalar.

    The paper's second term of L_photo (§4.2): the occupancy map A against the complete mask. Arguments as
    `l1`, and:

    Args:
        a: see `l1`.
        b: see `l1`.
        mask: see `l1`.
        weights: factors on the squares, of the same shape; the count that they are divided by stays. None: all 1.
    """
    _check_shapes(a, b, mask)
    if weights is None:
        return masked_mean(_difference(a, b, mask).square(), mask)
    counts = weights != 0
    if mask is not None:
        counts = counts & (mask if a.dim() == 2 else mask[..., None])
    squares = torch.where(counts, a - b, 0.0).square() * weights
    return masked_mean(squares, mask)


def ssim_loss(a: Tensor, b: Tensor, mask: Tensor | None = None) -> Tensor:
    """Returns 1 - SSIM, the map of `ssim_map` averaged over the pixels of `mask` and all channels, a scalar.

    The windows see pixels outside the mask: black both pictures there first when these are not to count.

    Args:
        a: `[H, W, C]`, 0..1.
        b: the same shape.
        mask: bool `[H, W]`; all pixels when None.
    """
    _check_shapes(a, b, mask)
    return masked_mean(1.0 - ssim_map(a, b), mask)


def l1_and_ssim(
    a: Tensor, b: Tensor, mask: Tensor, margin: int = 0, *, compiled: bool = True
) -> tuple[Tensor, Tensor]:
    """Returns `l1` over the pixels of a mask and `ssim_loss` over those within it, outside of which windows see black.

    Args:
        a: `[H, W, C]`, 0..1; the picture that is trained.
        b: the same shape, without gradient.
        mask: bool `[H, W]`.
        margin: pixels at the mask's edge that SSIM does not see (`within`).
        compiled: by the kernel of `quality/fused.py` where it takes the picture: float32 on a CPU.
    """
    _check_shapes(a, b, mask)
    inner = within(mask, margin)
    if compiled and a.dtype == torch.float32 and a.device.type == "cpu":
        # numba is loaded where it is used
        from occfusion.quality import fused

        return fused.l1_and_ssim(a, b, mask, inner)
    if a.is_cuda and is_recording() and min(mask.shape) >= 2 * WINDOW:
        # which takes the terms from here
        from occfusion.quality import recorded

        return recorded.l1_and_ssim(a, b, mask, inner)
    return l1(a, b, mask), masked_ssim_loss(a, b, inner)


def masked_ssim_loss(a: Tensor, b: Tensor, mask: Tensor) -> Tensor:
    """Returns `ssim_loss` over the pixels of a mask, outside of which windows see black."""
    black = mask[..., None]
    return ssim_loss(a * black, b * black, mask)


def within(mask: Tensor, margin: int) -> Tensor:
    """Returns the pixels of a mask that are more than a margin away from all that are not, along rows and columns.

    What lies outside of the picture is not known, so the mask has no edge there.

    Args:
        mask: bool `[H, W]`.
        margin: pixels; with 0 it is the mask itself.
    """
    if mask.is_cuda and margin > 0:
        return _within_by_pooling(mask, margin)
    inner = mask
    for axis in (0, 1):
        line, length = inner, mask.shape[axis]
        for step in range(1, min(margin, length - 1) + 1):
            inner = inner.clone() if inner is line else inner
            inner.narrow(axis, step, length - step).logical_and_(line.narrow(axis, 0, length - step))
            inner.narrow(axis, 0, length - step).logical_and_(line.narrow(axis, step, length - step))
    return inner


def _within_by_pooling(mask: Tensor, margin: int) -> Tensor:
    """Returns `within` by one kernel instead of two for each pixel of the margin: for a GPU."""
    off = functional.max_pool2d((~mask)[None, None].float(), 2 * margin + 1, stride=1, padding=margin)
    return off[0, 0] == 0


def masked_mean(values: Tensor, mask: Tensor | None = None) -> Tensor:
    """Returns the mean of `[H, W]` or `[H, W, C]` over the pixels of `mask`; 0 for an empty region.

    Pixels outside the mask get a gradient of exactly 0, also where the value there is not finite.
    """
    if mask is None:
        return values.sum() / max(values.numel(), 1)
    if values.dim() == 3:
        mask = mask[..., None].expand_as(values)
    # where, not values[mask]: gathering by a mask is ten times slower backwards, multiplying would keep a NaN
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)


def _difference(a: Tensor, b: Tensor, mask: Tensor | None) -> Tensor:
    """Returns a - b, and 0 outside the mask: the derivative of what is there, which may be NaN, is never asked for."""
    if mask is None:
        return a - b
    return torch.where(mask if mask.dim() == a.dim() else mask[..., None], a - b, 0.0)


def _check_shapes(a: Tensor, b: Tensor, mask: Tensor | None) -> None:
    if a.shape != b.shape:
        raise ValueError(f"the two pictures differ in shape: {list(a.shape)} and {list(b.shape)}")
    if mask is not None and mask.shape != a.shape[:2]:
        raise ValueError(f"the mask {list(mask.shape)} does not fit a picture {list(a.shape)}")
