"""The embedded inpainter: a diffusion model of what a coarse rendering of a person lacks."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from occfusion.inpaint.planes import COARSE, PLANES
from occfusion.priors.unet import BlockUNet

KNEE = 0.015
"""Difference between truth and rendering up to which the signal grows in proportion; beyond, with its logarithm."""
SPAN = math.asinh(1.0 / KNEE)
"""Of the largest difference, 1, whose signal is 1."""


class AppearanceNet(nn.Module):
    """Predicts v of the difference between the person and its coarse rendering.

    The signal is that difference, not the person: where the rendering is good, and mostly it is, there is little to
    say, and details of the rendering finer than the crop are kept.

    Args:
        widths: channels at each level.
        depth: residual blocks of the lower levels.
    """

    def __init__(self, widths: tuple[int, ...] = (64, 96, 160), depth: int = 2) -> None:
        super().__init__()
        self.net = BlockUNet(3, 3 + len(PLANES), 0, tuple(widths), depth)

    def forward(self, noisy: Tensor, t: Tensor, planes: Tensor) -> Tensor:
        """Returns v, `[B, 3, S, S]`, for `noisy [B, 3, S, S]`, `t [B]` and `planes [B, 15, S, S]`."""
        fine = torch.cat([noisy, planes], dim=1).contiguous(memory_format=torch.channels_last)
        nothing = fine.new_zeros(len(fine), 0, fine.shape[2] // 4, fine.shape[3] // 4)
        prediction: Tensor = self.net(fine, nothing, t)
        return prediction


def to_signal(truth: Tensor, planes: Tensor) -> Tensor:
    """Returns the signal for the true pictures `[B, 3, S, S]`, in -1..1.

    Differences are companded: most are a few hundredths or less, which a diffusion of standard noise would drown,
    while the few large ones, where an outline is wrong, would decide the fit. The mean of a companded signal lies
    towards the median, and a reference counts by L1 (paper §4.3).
    """
    return torch.asinh((truth - planes[:, COARSE]) / KNEE) / SPAN


def from_signal(signal: Tensor) -> Tensor:
    """Returns what is to be added to the coarse rendering, for signals in -1..1."""
    return KNEE * torch.sinh(SPAN * signal)
