"""The embedded prior of silhouettes, as a prior of masks and as one whose score is distilled."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.fields import setting
from occfusion.observation.crop import PersonView, Square, view_observation
from occfusion.observation.frames import Observation
from occfusion.priors.distillation import guided
from occfusion.priors.embedded.conditions import Conditions, make_conditions
from occfusion.priors.embedded.diffusion import alpha_sigma, clean_and_noise, sample
from occfusion.priors.embedded.silhouette_net import load_silhouette_net
from occfusion.priors.masks import MaskPrior
from occfusion.priors.score import ScorePrior


@dataclass(frozen=True)
class EmbeddedSettings:
    """Settings of `prior=embedded`."""

    samples: int = setting(
        0,
        "posterior samples a frame, whose mean is the probability; 0: the posterior mean, by `draws` evaluations of "
        "the network, fused with the body mesh",
        0,
    )
    draws: int = setting(2, "evaluations of the posterior mean, each with other noise", 1)
    steps: int = setting(20, "evaluations for each sample", 1)
    seed: int = setting(
        0, "of the noise, which all frames share: what differs between frames is then what they show", 0
    )
    weights: str | None = setting(None, "a `.safetensors` file of `stage=prior`; null: the package's")


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
        """Returns the crop of a frame and what the network is conditioned on."""
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
        predict = partial(self.net, conditions=conditions.expand(count))
        samples = sample(predict, noise.repeat(len(conditions), 1, 1, 1), settings.steps)
        silhouettes = (samples > 0.0).to(noise.dtype)
        return silhouettes.reshape(len(conditions), count, *noise.shape[1:]).mean(dim=1)


def make_view_conditions(view: PersonView) -> Conditions:
    """Returns what the network is conditioned on for a view: one crop, on the CPU; what is not known is zero."""
    body = view.body()
    seen = view.seen(body)
    unknown = np.zeros((view.size, view.size), np.float32)
    parts = (
        unknown if view.visible is None else view.visible,
        unknown if view.background is None else view.background,
        body.coverage, body.relative_depth, (seen.pixels / view.size).astype(np.float32), seen.shown,
    )  # fmt: skip
    return make_conditions(*(torch.from_numpy(part)[None] for part in parts))


EVERYTHING = ("visible", "background", "body", "limbs")


class EmbeddedScore(ScorePrior[Conditions]):
    """Predicts noise by our own diffusion model of silhouettes.

    Args:
        weights: a `.safetensors` file of `stage=prior`; None: the package's.
        device: where the network runs.

    Raises:
        DataError: the weights are missing or damaged.
    """

    name = "embedded"

    def __init__(self, weights: str | None = None, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self.net, self.card = load_silhouette_net(weights)
        self.net.to(self.device)
        self.size = int(self.card["size"])
        self.signal_shape = (1, self.size, self.size)

    def describe(self) -> dict[str, Any]:
        """Returns the hash of the weights."""
        return {"prior": self.name, "weights_sha256": self.card["sha256"]}

    def encode_conditions(self, view: PersonView) -> Conditions:
        """Returns the conditions of the network."""
        return make_view_conditions(view).to(self.device)

    def encode(self, occupancy: Tensor) -> Tensor:
        """Returns the map in -1..1."""
        return 2.0 * occupancy.float() - 1.0

    def levels(self, t: float) -> tuple[float, float]:
        """Returns the levels of the cosine schedule."""
        alpha, sigma = alpha_sigma(torch.tensor(t, dtype=torch.float64))
        return float(alpha), float(sigma)

    @torch.no_grad()
    def predict_noise(self, noisy: Tensor, t: float, conditions: Conditions, guidance: float) -> Tensor:
        """Returns the noise; without conditions means without any, the pose included."""
        if guidance == 1.0:
            return self._predict(noisy, t, conditions)
        unconditional = self._predict(noisy, t, conditions.without(*EVERYTHING))
        if guidance == 0.0:
            return unconditional
        return guided(unconditional, self._predict(noisy, t, conditions), guidance)

    def _predict(self, noisy: Tensor, t: float, conditions: Conditions) -> Tensor:
        times = torch.full((1,), t, dtype=noisy.dtype, device=noisy.device)
        return clean_and_noise(noisy, self.net(noisy, times, conditions), times)[1]
