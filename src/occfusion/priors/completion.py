"""How well a network completes silhouettes: IoU inside the hidden region."""

from __future__ import annotations

import torch
from torch import Tensor

from occfusion.priors.batches import Batch
from occfusion.priors.diffusion import posterior_mean
from occfusion.priors.silhouette import SilhouetteNet


def hidden_iou(completed: Tensor, clean: Tensor, hidden: Tensor) -> Tensor:
    """Returns the IoU of masks inside the hidden region, `[B]`; bool `[B, 1, S, S]` each; 1 where both are empty."""
    both = (completed & clean & hidden).sum(dim=(1, 2, 3))
    either = ((completed | clean) & hidden).sum(dim=(1, 2, 3))
    return torch.where(either > 0, both / either.clamp(min=1), torch.ones_like(either, dtype=torch.float32))


@torch.no_grad()
def completion_iou(net: SilhouetteNet, batch: Batch, device: torch.device, seed: int = 0) -> Tensor:
    """Returns the hidden IoU of each crop by one evaluation of the posterior mean, `[B]`."""
    conditions = batch.conditions.to(device)
    noise = torch.randn(batch.clean.shape, generator=torch.Generator().manual_seed(seed)).to(device)
    mean = posterior_mean(lambda x, t: net(x, t, conditions), noise).cpu()
    hidden = (batch.conditions.visible + batch.conditions.background) == 0
    return hidden_iou(mean > 0.0, batch.clean > 0.0, hidden)
