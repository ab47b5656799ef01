"""The score of the embedded prior: occupancy as a picture in -1..1, no encoder."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from occfusion.priors.conditions import Conditions
from occfusion.priors.diffusion import alpha_sigma, clean_and_noise
from occfusion.priors.distillation import guided
from occfusion.priors.embedded import make_view_conditions
from occfusion.priors.score import ScorePrior
from occfusion.priors.views import PersonView
from occfusion.priors.weights import load_silhouette_net

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

    def look(self, view: PersonView) -> Conditions:
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
    def predict_noise(self, noisy: Tensor, t: float, told: Conditions, guidance: float) -> Tensor:
        """Returns the noise; without conditions means without any, the pose included."""
        if guidance == 1.0:
            return self._predict(noisy, t, told)
        unconditional = self._predict(noisy, t, told.without(*EVERYTHING))
        if guidance == 0.0:
            return unconditional
        return guided(unconditional, self._predict(noisy, t, told), guidance)

    def _predict(self, noisy: Tensor, t: float, told: Conditions) -> Tensor:
        times = torch.full((1,), t, dtype=noisy.dtype, device=noisy.device)
        return clean_and_noise(noisy, self.net(noisy, times, told), times)[1]
