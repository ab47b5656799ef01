"""A small U-Net that works on blocks of pixels, for signals that are simple except at their edges."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

TIME_FREQUENCIES = 16
GROUPS = 8
BLOCK = 4
"""Pixels a side of the blocks that pictures enter as."""
DETAIL_CHANNELS = 64


class ResidualBlock(nn.Module):
    """Two convolutions around a residual path; the time scales and shifts between them."""

    def __init__(self, channels_in: int, channels: int, time_channels: int) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(GROUPS, channels_in)
        self.conv1 = nn.Conv2d(channels_in, channels, 3, padding=1)
        self.time = nn.Linear(time_channels, 2 * channels)
        self.norm2 = nn.GroupNorm(GROUPS, channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)
        self.skip = nn.Identity() if channels_in == channels else nn.Conv2d(channels_in, channels, 1)
        nn.init.zeros_(self.conv2.weight)

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        """Returns `[B, channels, H, W]` for `x [B, channels_in, H, W]` and `time [B, time_channels]`."""
        h = self.conv1(F.silu(self.norm1(x)))
        scale, shift = self.time(time)[..., None, None].chunk(2, dim=1)
        h = F.silu(self.norm2(h) * (1.0 + scale) + shift)
        return self.skip(x) + self.conv2(h)


class BlockUNet(nn.Module):
    """Predicts v from a noisy signal and its conditions.

    Pictures enter as blocks of `BLOCK` x `BLOCK` pixels, each a vector (pixel unshuffle): the silhouette inside a
    block is simple, and the network's cost falls by the square of `BLOCK`.

    Args:
        channels_out: channels of the signal.
        channels_in: channels of the signal and of the conditions at its resolution, together.
        channels_coarse: channels of the conditions at the resolution of the blocks.
        widths: channels at each level, each a multiple of 8; a level has half the resolution of the one before.
        depth: residual blocks of each level below the first, on either side; the first has one on either side.
    """

    def __init__(
        self,
        channels_out: int,
        channels_in: int,
        channels_coarse: int,
        widths: tuple[int, ...] = (48, 96, 160),
        depth: int = 2,
    ) -> None:
        super().__init__()
        time_channels = 2 * widths[0]
        self.time = nn.Sequential(nn.Linear(2 * TIME_FREQUENCIES, time_channels), nn.SiLU())
        self.enter = nn.Conv2d(channels_in * BLOCK**2 + channels_coarse, widths[0], 3, padding=1)
        self.down, self.shrink = nn.ModuleList(), nn.ModuleList()
        self.up, self.grow = nn.ModuleList(), nn.ModuleList()
        for level, width in enumerate(widths):
            count = 1 if level == 0 else depth
            self.down.append(nn.ModuleList(ResidualBlock(width, width, time_channels) for _ in range(count)))
            first = [ResidualBlock(2 * width, width, time_channels)]
            rest = [ResidualBlock(width, width, time_channels) for _ in range(count - 1)]
            self.up.append(nn.ModuleList(first + rest))
            if level + 1 < len(widths):
                self.shrink.append(nn.Conv2d(width, widths[level + 1], 3, stride=2, padding=1))
                self.grow.append(nn.Conv2d(widths[level + 1], width, 1))
        self.leave = nn.Conv2d(widths[0], channels_out * BLOCK**2, 3, padding=1)
        nn.init.zeros_(self.leave.weight)
        # single pixels do not fit through the first level's width: the last layers see the input once more
        self.detail = nn.Sequential(
            nn.Conv2d(widths[0] + channels_in * BLOCK**2, DETAIL_CHANNELS, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(DETAIL_CHANNELS, channels_out * BLOCK**2, 3, padding=1),
        )
        nn.init.zeros_(self.detail[-1].weight)  # type: ignore[arg-type]

    def forward(self, fine: Tensor, coarse: Tensor | None, t: Tensor) -> Tensor:
        """Returns v, `[B, channels_out, S, S]`.

        Args:
            fine: noisy signal and conditions, `[B, channels_in, S, S]`; S a multiple of `BLOCK`, and of 2 for
                each further level.
            coarse: `[B, channels_coarse, S / BLOCK, S / BLOCK]`; None where there are no such channels.
            t: diffusion time, `[B]`, 0..1.
        """
        time = self.time(_time_features(t))
        blocks = F.pixel_unshuffle(fine, BLOCK)
        x = self.enter(blocks if coarse is None else torch.cat([blocks, coarse], dim=1))
        kept: list[Tensor] = []
        for level, layers in enumerate(self.down):
            for block in layers:  # type: ignore[attr-defined]
                x = block(x, time)
            kept.append(x)
            if level < len(self.shrink):
                x = self.shrink[level](x)
        for level in reversed(range(len(self.up))):
            x = torch.cat([x, kept[level]], dim=1)
            for block in self.up[level]:  # type: ignore[attr-defined]
                x = block(x, time)
            if level:
                x = F.interpolate(self.grow[level - 1](x), scale_factor=2.0, mode="nearest")
        x = F.silu(x)
        out = self.leave(x) + self.detail(torch.cat([x, blocks], dim=1))
        return F.pixel_shuffle(out, BLOCK)


def _time_features(t: Tensor) -> Tensor:
    frequencies = math.pi * torch.arange(1, TIME_FREQUENCIES + 1, dtype=t.dtype, device=t.device)
    angles = t[:, None] * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=1)
