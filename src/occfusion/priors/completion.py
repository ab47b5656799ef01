"""How well a network completes silhouettes: IoU inside the hidden region."""

from __future__ import annotations

from collections.abc import Iterable

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
    """Returns the hidden IoU of each crop by one evaluation, `[B]`."""
    conditions = batch.conditions.to(device)
    noise = torch.randn(1, *batch.clean.shape[1:], generator=torch.Generator().manual_seed(seed)).to(device)
    completed = net.probability(conditions, noise).cpu() > 0.5
    hidden = (batch.conditions.visible + batch.conditions.background) == 0
    return hidden_iou(completed, batch.clean > 0.0, hidden)


@torch.no_grad()
def fit_fusion(net: SilhouetteNet, batches: Iterable[Batch], device: torch.device, seed: int = 0) -> None:
    """Fits how a network's posterior mean and the body are fused; see `BodyFusion`.

    Args:
        net: trained; its fusion is set.
        batches: of silhouettes that it was not trained on, their bodies as wrong as in use.
        device: where it runs.
        seed: of the noise.
    """
    answers = []
    for batch in batches:
        conditions = batch.conditions.to(device)
        noise = torch.randn(batch.clean.shape, generator=torch.Generator().manual_seed(seed)).to(device)
        mean = posterior_mean(lambda x, t, c=conditions: net(x, t, c), noise)  # type: ignore[misc]
        answers.append((mean.cpu(), batch.conditions, batch.clean))
    net.fusion.fit(answers)
