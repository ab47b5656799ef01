"""The photometric loss terms of one picture; each is 0, gradient too, where there is nothing to compare."""

from __future__ import annotations

import torch
from torch import Tensor

from occfusion.quality.ssim import ssim_map

__all__ = ["l1", "l2", "masked_mean", "ssim_loss", "ssim_map"]


def l1(a: Tensor, b: Tensor, mask: Tensor | None = None) -> Tensor:
    """Returns the mean absolute difference over the pixels of `mask` and all channels, a scalar.

    The paper's first term of L_photo (§4.2), with M as the mask.

    Args:
        a: `[H, W, C]` or `[H, W]`.
        b: the same shape.
        mask: bool `[H, W]`; all pixels when None.
    """
    _check_shapes(a, b, mask)
    return masked_mean((a - b).abs(), mask)


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
    squares = (a - b).square()
    if weights is not None:
        squares = torch.where(weights != 0, squares * weights, 0.0)
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


def _check_shapes(a: Tensor, b: Tensor, mask: Tensor | None) -> None:
    if a.shape != b.shape:
        raise ValueError(f"the two pictures differ in shape: {list(a.shape)} and {list(b.shape)}")
    if mask is not None and mask.shape != a.shape[:2]:
        raise ValueError(f"the mask {list(mask.shape)} does not fit a picture {list(a.shape)}")
