"""The recipe of the silhouette prior: dressed people in wide poses."""

from __future__ import annotations

from pathlib import Path

import torch

from occfusion.priors.batches import Batch, fusion_batches, validation_batches
from occfusion.priors.completion import completion_iou, fit_fusion
from occfusion.priors.corpus import SIZE
from occfusion.priors.corpus_folder import Corpus
from occfusion.priors.silhouette import SilhouetteNet
from occfusion.priors.weights import SILHOUETTE
from occfusion.recipes.recipe import Recipe
from occfusion.settings.stages import PriorTrainingSettings

FUSION_SILHOUETTES = 1500


class SilhouetteRecipe(Recipe[SilhouetteNet]):
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
        return {f"{kind}_iou": _mean_iou(net, batches, device) for kind, batches in self._batches.items()}

    def finish(self, net: SilhouetteNet, device: torch.device) -> dict[str, float]:
        """Fits how the network's answers and the body are fused, on silhouettes that it was not trained on."""
        count = min(FUSION_SILHOUETTES, self.settings.examples)
        fit_fusion(net, fusion_batches(count, self.seed + 2), device)
        return {f"fused_{name}": value for name, value in self.measure(net, device).items()}


def _mean_iou(net: SilhouetteNet, batches: list[Batch], device: torch.device) -> float:
    return float(torch.cat([completion_iou(net, batch, device) for batch in batches]).mean())
