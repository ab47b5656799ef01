"""`losses.l1_and_ssim` on a GPU: pictures are filled up to a few sizes, for which it is recorded as a CUDA graph.

Every frame has a window of another size, and a recording has one. What is filled in counts for nothing: SSIM sees the
mirrored border as it does without, and beyond it only pixels that are in no mask.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from occfusion.gpu.graphs import GraphedFunction
from occfusion.quality import losses
from occfusion.quality.ssim import WINDOW

STEP = 128
"""Pixels: sizes are multiples of it."""
REACH = WINDOW // 2


def l1_and_ssim(a: Tensor, b: Tensor, mask: Tensor, inner: Tensor) -> tuple[Tensor, Tensor]:
    """Returns what `losses.l1_and_ssim` does.

    Args:
        a: `[H, W, C]`, 0..1, no side shorter than two windows of SSIM.
        b: the same shape, without gradient.
        mask: of the L1, bool `[H, W]`.
        inner: of SSIM, bool `[H, W]`.
    """
    found: tuple[Tensor, Tensor] = _GRAPHED(*filled(a, b, mask, inner))  # type: ignore[assignment]
    return found


def filled(a: Tensor, b: Tensor, mask: Tensor, inner: Tensor) -> tuple[Tensor, Tensor]:
    """Returns pictures and masks of a whole number of `STEP`s.

    Returns:
        Planes `[2 C + 1, H', W']`: both pictures and SSIM's mask, their lower and right borders mirrored as far as the
        window reaches; and both masks, bool `[2, H', W']`.
    """
    height, width = mask.shape
    down, right = (-(-(side + REACH) // STEP) * STEP - side for side in (height, width))
    planes = torch.cat([a, b, inner[..., None].to(a.dtype)], dim=2).permute(2, 0, 1)
    mirrored = functional.pad(planes[None], (0, REACH, 0, REACH), mode="reflect")[0]
    return (
        functional.pad(mirrored, (0, right - REACH, 0, down - REACH)),
        functional.pad(torch.stack([mask, inner]), (0, right, 0, down)),
    )


def of_filled(planes: Tensor, masks: Tensor) -> tuple[Tensor, Tensor]:
    """Returns L1 and 1 - SSIM of what `filled` gives."""
    count = len(planes) // 2
    a, b, seen = (part.permute(1, 2, 0) for part in planes.split([count, count, 1]))
    return losses.l1(a, b, masks[0]), losses.ssim_loss(a * seen, b * seen, masks[1])


_GRAPHED = GraphedFunction(of_filled)
