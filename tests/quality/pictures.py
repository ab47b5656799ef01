"""Pictures for the tests of the image metrics, from formulas."""

from __future__ import annotations

import torch
from torch import Tensor


def waves(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Two smooth pictures, not far from each other, in 0..1."""
    y = torch.arange(height, dtype=torch.float64)[:, None, None]
    x = torch.arange(width, dtype=torch.float64)[None, :, None]
    c = torch.arange(3, dtype=torch.float64)
    a = 0.5 + 0.3 * torch.sin(0.21 * x + 0.13 * y + c) + 0.2 * torch.cos(0.05 * x * (c + 1) - 0.17 * y)
    b = (
        0.5
        + 0.3 * torch.sin(0.21 * (x + 1.5) + 0.13 * y + c)
        + 0.15 * torch.cos(0.05 * x * (c + 1) - 0.11 * y)
    )
    return a.float(), b.float()


def noise(
    height: int, width: int, *, seed: int = 0, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor]:
    """A random picture and a disturbed copy, in 0..1."""
    generator = torch.Generator().manual_seed(seed)
    a = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    b = (a + 0.2 * torch.randn(height, width, 3, generator=generator, dtype=torch.float64)).clamp(0, 1)
    return a.to(dtype), b.to(dtype)
