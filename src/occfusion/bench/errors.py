"""How far pictures and gradients are from the reference."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from occfusion.bench.contestants import Contestant, Pictures
from occfusion.bench.reference import Reference
from occfusion.bench.scenes import BenchScene

FLIP = 1e-5
"""A larger error of a colour is a threshold that was crossed in one precision and not in the other."""


@dataclass(frozen=True)
class Errors:
    """Distances from the reference.

    Attributes:
        rgb: largest absolute error of a colour.
        alpha: largest absolute error of alpha.
        depth: largest absolute error of depth, metres; None where the contestant has no depth.
        flips: share of pixels with a colour error above `FLIP`.
        gradients: relative error in the 2-norm, by input.
    """

    rgb: float
    alpha: float
    depth: float | None
    flips: float
    gradients: dict[str, float]

    @property
    def worst_gradient(self) -> float:
        """The largest of the gradients' errors."""
        return max(self.gradients.values())


def errors_of(contestant: Contestant, scene: BenchScene, reference: Reference) -> Errors:
    """Returns the errors of a contestant; not-a-number where it gives one."""
    pictures, gradients = contestant.gradients(scene)
    return compare(pictures, gradients, reference)


def compare(pictures: Pictures, gradients: dict[str, Tensor], reference: Reference) -> Errors:
    """Returns the errors of given pictures and gradients."""
    rgb, alpha, depth = pictures
    colour = _distance(rgb, reference.rgb)
    relative = {}
    for name, wanted in reference.gradients.items():
        difference = gradients[name].detach().cpu().double() - wanted
        relative[name] = float(difference.norm() / wanted.norm().clamp(min=torch.finfo(torch.float64).tiny))
    return Errors(
        rgb=float(colour.max()),
        alpha=float(_distance(alpha, reference.alpha).max()),
        depth=None if depth is None else float(_distance(depth, reference.depth).max()),
        flips=float((colour.amax(dim=2) > FLIP).double().mean()),
        gradients=relative,
    )


def _distance(ours: Tensor, wanted: Tensor) -> Tensor:
    return (ours.detach().cpu().double() - wanted).abs()
