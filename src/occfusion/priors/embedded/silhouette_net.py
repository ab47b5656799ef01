"""The embedded prior of silhouettes: a diffusion model of what a whole person's mask looks like in a square crop."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from occfusion.priors.embedded.body_fusion import BodyFusion
from occfusion.priors.embedded.conditions import NUM_MAPS, Conditions
from occfusion.priors.embedded.diffusion import posterior_mean
from occfusion.priors.embedded.network_file import Card, load_net
from occfusion.priors.embedded.unet import BlockUNet

SILHOUETTE = "silhouette"
SIZE = 128
"""Pixels a side of the crop."""


class SilhouetteNet(nn.Module):
    """Predicts v of a silhouette in -1..1 from its noisy version and the conditions.

    Args:
        widths: channels at each level.
        depth: residual blocks of the lower levels.
    """

    def __init__(self, widths: tuple[int, ...] = (48, 96, 160), depth: int = 2) -> None:
        super().__init__()
        self.net = BlockUNet(1, 5, NUM_MAPS, tuple(widths), depth)
        self.fusion = BodyFusion()

    def forward(self, noisy: Tensor, t: Tensor, conditions: Conditions) -> Tensor:
        """Returns v, `[B, 1, S, S]`, for `noisy [B, 1, S, S]` and `t [B]`."""
        c = conditions
        fine = torch.cat([noisy, c.visible, c.background, c.body], dim=1)
        fine = fine.contiguous(memory_format=torch.channels_last)
        return self.net(fine, c.limbs, t)

    @torch.no_grad()
    def probability(self, conditions: Conditions, noise: Tensor) -> Tensor:
        """Returns the probability of the person: posterior mean and body mesh, fused, `[B, 1, S, S]`.

        Args:
            conditions: of B crops.
            noise: `[D, 1, S, S]`, the same for all crops; the mean of D evaluations is taken.
        """
        expanded = conditions.expand(len(noise))
        repeated = noise.repeat(len(conditions), 1, 1, 1)
        means = posterior_mean(lambda noisy, t: self(noisy, t, expanded), repeated)
        return self.fusion(means.reshape(len(conditions), *noise.shape).mean(dim=1), conditions)


def load_silhouette_net(path: str | Path | None = None) -> tuple[SilhouetteNet, Card]:
    """Returns the silhouette network, ready to evaluate, and its card; see `load_net`."""
    return load_net(path, SILHOUETTE, SIZE, SilhouetteNet, "prior.weights")
