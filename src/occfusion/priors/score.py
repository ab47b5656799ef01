"""The interface of the priors whose score is distilled, and the loss made of one (paper §4.2)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from occfusion.observation.crop import PersonView
from occfusion.priors.distillation import surrogate, weight

T = TypeVar("T")
"""What a prior makes of a view once, to condition it on many times."""


class ScorePrior(ABC, Generic[T]):
    """An interface: predicts the noise in an occupancy map of a person.

    Attributes:
        name: what settings and errors call it.
        size: pixels a side of the occupancy maps that it takes.
        signal_shape: of the signal that it diffuses, `(C, h, w)`.
        device: where it runs.
    """

    name: str
    size: int
    signal_shape: tuple[int, int, int]
    device: torch.device

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Returns all that decides its answers: plain numbers and text."""

    @abstractmethod
    def encode_conditions(self, view: PersonView) -> T:
        """Returns what it is conditioned on for a view of its size."""

    @abstractmethod
    def encode(self, occupancy: Tensor) -> Tensor:
        """Returns the signal of an occupancy map, `[1, C, h, w]`, float32; differentiable.

        Args:
            occupancy: `[1, 1, size, size]`, 0..1.
        """

    @abstractmethod
    def levels(self, t: float) -> tuple[float, float]:
        """Returns alpha and sigma of `x_t = alpha x + sigma noise` at a time, 0..1."""

    @abstractmethod
    def predict_noise(self, noisy: Tensor, t: float, conditions: T, guidance: float) -> Tensor:
        """Returns the noise that it sees in `noisy [1, C, h, w]`, float32, without a graph.

        Args:
            noisy: `x_t`.
            t: the time.
            conditions: of `encode_conditions`.
            guidance: 1: with the conditions, 0: without; each then takes one evaluation, anything else two.
        """


@dataclass(frozen=True)
class Draw:
    """What chance decides about one distillation.

    Attributes:
        t: diffusion time, 0..1.
        noise: standard normal, `[1, C, h, w]`.
    """

    t: float
    noise: Tensor


def distil(
    prior: ScorePrior[T], occupancy: Tensor, mask: Tensor, conditions: T, draw: Draw,
    *, weighting: str, guidance: float, reduction: str,
) -> Tensor:  # fmt: skip
    """Returns the distillation loss of an occupancy map, a scalar; see `distillation.surrogate`.

    The gradient is exactly zero at pixels outside the mask. A score that is not finite makes the loss not finite.

    Args:
        prior: whose score.
        occupancy: `[S, S]`, 0..1, S the prior's size.
        mask: pixels whose gradient is wanted, `[S, S]`, 0 or 1.
        conditions: of `prior.encode_conditions`.
        draw: time and noise.
        weighting: of `distillation.WEIGHTINGS`.
        guidance: of `predict_noise`.
        reduction: of `distillation.REDUCTIONS`.
    """
    # a latent signal mixes neighbouring pixels, so known ones are held before it is made as well
    held = torch.where(mask > 0.0, occupancy, occupancy.detach())
    signal = prior.encode(held[None, None])
    alpha, sigma = prior.levels(draw.t)
    noisy = alpha * signal.detach() + sigma * draw.noise
    predicted = prior.predict_noise(noisy, draw.t, conditions, guidance)
    gradient = weight(weighting, sigma) * (predicted - draw.noise)
    place = F.adaptive_avg_pool2d(mask[None, None], prior.signal_shape[1:])
    return surrogate(signal, gradient, place, reduction)
