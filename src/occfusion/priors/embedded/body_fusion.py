"""How far the answer of the silhouette prior and the body mesh are each believed, by how the mesh fits what is seen.

The network is given bodies that may be wrong and stays careful with those that are exact. What is seen beside the
occluder says which they are: the share of the body that lies where the background is known (a wrong pose), and the
share of the person that the body does not cover (clothes). A logistic regression on both, on the answer and on the
distance to the body's outline, gives the fused answer (stacked generalisation, Wolpert 1992).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from occfusion.geometry.distance import signed_distance
from occfusion.priors.embedded.conditions import Conditions
from occfusion.priors.logistic import fit_logistic

SHAPES, FITS = 6, 3
"""Functions of answer and distance, functions of the fit; the regression has a weight for each pair."""
UNIT = 1 / 32
"""Crop widths: the unit of distance."""
FARTHEST = 3.0
"""Units of distance beyond which it counts as this."""
SURE = 0.99
"""An answer of -1..1 beyond which it counts as this."""
STRENGTH = 1.0
"""Of the prior belief that the answer alone is right, in pixels."""


class BodyFusion(nn.Module):
    """Corrects a posterior mean by the body mesh, where something is hidden; starts as the identity.

    Attributes:
        weights: of the regression, `[6, 3]`.
    """

    weights: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("weights", identity())

    @torch.no_grad()
    def forward(self, mean: Tensor, conditions: Conditions) -> Tensor:
        """Returns the probability of the person, `[B, 1, S, S]`.

        Pixels that are known keep `(1 + mean) / 2`, and so do crops that lack the body, the person or the background.

        Args:
            mean: posterior mean in -1..1, `[B, 1, S, S]`.
            conditions: what the network was given.
        """
        fused = 0.5 + 0.5 * mean
        if torch.equal(self.weights, identity().to(self.weights)):
            return fused
        for row in usable(conditions):
            crop = conditions[row : row + 1]
            features, hidden = fusion_features(mean[row : row + 1], crop)
            fused[row][hidden[0]] = torch.sigmoid(features.to(mean) @ self.weights.reshape(-1))
        return fused

    def fit(self, answers: list[tuple[Tensor, Conditions, Tensor]], most: int = 1_000_000) -> None:
        """Sets the weights to those that explain what was hidden.

        Args:
            answers: posterior means, conditions and true silhouettes (-1..1) of batches.
            most: pixels used, drawn evenly.
        """
        rows, labels = [], []
        for mean, conditions, clean in answers:
            for row in usable(conditions):
                features, hidden = fusion_features(mean[row : row + 1], conditions[row : row + 1])
                rows.append(features.cpu().numpy())
                labels.append((clean[row : row + 1][hidden] > 0).cpu().numpy())
        if not rows:
            return
        x, y = np.concatenate(rows), np.concatenate(labels)
        every = -(-len(y) // most)
        found = fit_logistic(
            x[::every].astype(np.float64), y[::every], identity().double().flatten().numpy(), STRENGTH
        )
        self.weights.copy_(torch.from_numpy(found).reshape(SHAPES, FITS))

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: object) -> None:
        # networks trained before there was a fusion have none, and none is the identity
        state_dict.setdefault(f"{prefix}weights", identity())
        super()._load_from_state_dict(state_dict, prefix, *rest)


def identity() -> Tensor:
    """Returns weights that leave an answer as it is: the logit counts once, nothing else does."""
    weights = torch.zeros(SHAPES, FITS)
    weights[1, 0] = 2.0  # atanh(2 p - 1) is half the logit of p
    return weights


def usable(conditions: Conditions) -> list[int]:
    """Returns which crops of a batch show the person, the background and a body."""
    parts = (conditions.visible, conditions.background, conditions.body[:, :1])
    there = torch.stack([(part > 0.5).flatten(1).any(dim=1) for part in parts]).all(dim=0)
    return [int(row) for row in there.nonzero()[:, 0]]


def fusion_features(mean: Tensor, conditions: Conditions) -> tuple[Tensor, Tensor]:
    """Returns the features of the hidden pixels of one crop, `[N, 18]`, and where they are, bool `[1, 1, S, S]`.

    Args:
        mean: `[1, 1, S, S]`.
        conditions: of one crop.
    """
    person, background = conditions.visible > 0.5, conditions.background > 0.5
    body = conditions.body[:, :1] > 0.5
    hidden = ~(person | background)
    union = (person | (body & ~hidden)).sum()
    beyond = (body & background).sum() / union  # of the body, where it cannot be
    beside = (person & ~body).sum() / union  # of the person, not covered
    fit = torch.stack([torch.ones_like(beyond), (beyond + 0.01).log() + 3.5, (beside + 0.01).log() + 3.0])
    distance = torch.from_numpy(signed_distance(body[0, 0].cpu().numpy(), window=3)).to(mean)[None, None][
        hidden
    ]
    d = (distance / (UNIT * mean.shape[-1])).clamp(-FARTHEST, FARTHEST)
    answer = mean[hidden].clamp(-SURE, SURE).atanh()
    ramps = (d.tanh(), (2.0 * d + 1.0).tanh(), (0.5 * d + 0.5).tanh())
    shapes = torch.stack([torch.ones_like(d), answer, d, *ramps], dim=1)
    return (shapes[:, :, None] * fit.to(mean)).flatten(1), hidden
