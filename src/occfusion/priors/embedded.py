"""The embedded mask prior: our own diffusion model of silhouettes, weights in the package."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.priors.conditions import Conditions, make_conditions
from occfusion.priors.crop import Square
from occfusion.priors.diffusion import sample
from occfusion.priors.masks import MaskPrior, Observation
from occfusion.priors.views import PersonView, view_observation
from occfusion.priors.weights import load_silhouette_net


@dataclass(frozen=True)
class EmbeddedSettings:
    """Settings of `prior=embedded`.

    Attributes:
        samples: posterior samples a frame, whose mean is the probability; 0: the posterior mean, by `draws`
            evaluations of the network, fused with the body mesh.
        draws: evaluations of the posterior mean, each with other noise.
        steps: evaluations for each sample.
        seed: of the noise, which all frames share: what differs between frames is then what they show.
        weights: a `.safetensors` file of `stage=prior`; null: the package's.
    """

    samples: int = 0
    draws: int = 2
    steps: int = 20
    seed: int = 0
    weights: str | None = None


class EmbeddedMaskPrior(MaskPrior):
    """Completes masks in a square crop around the body.

    Args:
        settings: how the posterior is summarised.
        device: where the network runs.
    """

    name = "embedded"

    def __init__(self, settings: EmbeddedSettings, device: torch.device | str = "cpu") -> None:
        self.settings = settings
        self.device = torch.device(device)
        self.net, self.card = load_silhouette_net(settings.weights)
        self.net.to(self.device)
        self.size = int(self.card["size"])

    def describe(self) -> dict[str, Any]:
        """Returns the settings and the hash of the weights."""
        own = {key: value for key, value in vars(self.settings).items() if key != "weights"}
        return {"prior": self.name, "weights_sha256": self.card["sha256"], **own}

    def probability(self, observation: Observation) -> NDArray[np.float32]:
        """Returns the probability of the person, `[H, W]`; 0 outside the crop."""
        square, conditions = self.conditions(observation)
        window = self.complete(conditions)[0, 0].cpu().numpy()
        height, width = observation.visible.shape
        return square.put(window, height, width, 0.0)

    def conditions(self, observation: Observation) -> tuple[Square, Conditions]:
        """Returns the crop of a frame and what the network is told of it."""
        square, view = view_observation(observation, self.size)
        return square, make_view_conditions(view).to(self.device)

    @torch.no_grad()
    def complete(self, conditions: Conditions) -> Tensor:
        """Returns the probability of the person in crops, `[B, 1, S, S]`, 0..1."""
        settings = self.settings
        count = settings.samples or settings.draws
        generator = torch.Generator().manual_seed(settings.seed)
        noise = torch.randn(count, 1, self.size, self.size, generator=generator).to(self.device)
        if not settings.samples:
            return self.net.probability(conditions, noise)
        expanded, noise = conditions.expand(count), noise.repeat(len(conditions), 1, 1, 1)

        def predict(noisy: Tensor, t: Tensor) -> Tensor:
            prediction: Tensor = self.net(noisy, t, expanded)
            return prediction

        silhouettes = (sample(predict, noise, settings.steps) > 0.0).to(noise.dtype)
        return silhouettes.reshape(len(conditions), count, *noise.shape[1:]).mean(dim=1)


def make_view_conditions(view: PersonView) -> Conditions:
    """Returns what the network is told of a view: one crop, on the CPU; what is not known is zero."""
    body = view.body()
    seen = view.seen(body)
    unknown = np.zeros((view.size, view.size), np.float32)
    parts = (
        unknown if view.visible is None else view.visible,
        unknown if view.background is None else view.background,
        body.coverage, body.relative_depth, (seen.pixels / view.size).astype(np.float32), seen.shown,
    )  # fmt: skip
    return make_conditions(*(torch.from_numpy(part)[None] for part in parts))
