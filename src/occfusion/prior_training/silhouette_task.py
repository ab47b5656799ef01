"""The task of the silhouette prior: dressed people in wide poses."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from occfusion.prior_training.silhouette_batches import Corpus, fusion_batches, validation_batches
from occfusion.prior_training.task import Batch, PriorTask
from occfusion.priors.embedded.diffusion import posterior_mean
from occfusion.priors.embedded.silhouette_net import SILHOUETTE, SIZE, SilhouetteNet
from occfusion.settings.stages import PriorTrainingSettings

FUSION_SILHOUETTES = 1500


class SilhouetteTask(PriorTask[SilhouetteNet]):
    """Silhouettes behind random occluders; measured on other poses of the training subjects.

    Args:
        settings: size of network and corpus.
        folder: of the corpus.
        seed: of corpus and batches.
    """

    kind, size = SILHOUETTE, SIZE
    data = "silhouettes of embedded subjects 0 to 99, made by this package"
    columns = ("centre_iou", "half_iou")

    def __init__(self, settings: PriorTrainingSettings, folder: Path, seed: int) -> None:
        self.settings = settings
        self.seed = seed
        self.corpus = Corpus(folder, settings.examples, seed)
        self._batches: dict[str, list[Batch]] | None = None

    def prepare(self) -> None:
        """Makes the corpus, unless it is there."""
        count = self.settings.examples
        for made in self.corpus.prepare():
            if made % max(1, count // 10) == 0:
                print(f"corpus: {made} of {count} silhouettes", flush=True)

    def make_net(self) -> SilhouetteNet:
        """Returns the network, untrained."""
        return SilhouetteNet(tuple(self.settings.widths), self.settings.depth)

    def batch(self, step: int) -> Batch:
        """Returns the batch of a training step."""
        return self.corpus.batch(step, self.settings.batch, self.seed)

    def measure(self, net: SilhouetteNet, device: torch.device) -> dict[str, float]:
        """Returns the mean IoU inside what is hidden, for two ways to hide half of a person."""
        if self._batches is None:
            self._batches = validation_batches(self.settings.validation, self.seed + 1)
        return {
            f"{kind}_iou": float(torch.cat([completion_iou(net, batch, device) for batch in batches]).mean())
            for kind, batches in self._batches.items()
        }

    def finish(self, net: SilhouetteNet, device: torch.device) -> dict[str, float]:
        """Fits how the network's answers and the body are fused, on silhouettes that it was not trained on."""
        count = min(FUSION_SILHOUETTES, self.settings.examples)
        fit_fusion(net, fusion_batches(count, self.seed + 2), device)
        return {f"fused_{name}": value for name, value in self.measure(net, device).items()}


def hidden_iou(completed: Tensor, clean: Tensor, hidden: Tensor) -> Tensor:
    """Returns the IoU of masks inside the hidden region, `[B]`; bool `[B, 1, S, S]` each; 1 where both are empty."""
    both = (completed & clean & hidden).sum(dim=(1, 2, 3))
    either = ((completed | clean) & hidden).sum(dim=(1, 2, 3))
    return torch.where(either > 0, both / either.clamp(min=1), torch.ones_like(either, dtype=torch.float32))


@torch.no_grad()
def completion_iou(net: SilhouetteNet, batch: Batch, device: torch.device) -> Tensor:
    """Returns the hidden IoU of each crop by one evaluation, `[B]`."""
    conditions = batch.conditions.to(device)
    noise = torch.randn(1, *batch.clean.shape[1:], generator=torch.Generator().manual_seed(0)).to(device)
    completed = net.probability(conditions, noise).cpu() > 0.5
    hidden = (batch.conditions.visible + batch.conditions.background) == 0
    return hidden_iou(completed, batch.clean > 0.0, hidden)


@torch.no_grad()
def fit_fusion(net: SilhouetteNet, batches: Iterable[Batch], device: torch.device) -> None:
    """Fits how a network's posterior mean and the body are fused; see `BodyFusion`.

    Args:
        net: trained; its fusion is set.
        batches: of silhouettes that it was not trained on, their bodies as wrong as in use.
        device: where it runs.
    """
    answers = []
    for batch in batches:
        conditions = batch.conditions.to(device)
        noise = torch.randn(batch.clean.shape, generator=torch.Generator().manual_seed(0)).to(device)
        mean = posterior_mean(partial(net, conditions=conditions), noise)
        answers.append((mean.cpu(), batch.conditions, batch.clean))
    net.fusion.fit(answers)
