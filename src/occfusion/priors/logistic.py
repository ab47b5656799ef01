"""Logistic regression with a Gaussian prior on its weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

NEWTON_STEPS = 12
LIMIT = 30.0
"""Of a logit: beyond it the probability is 0 or 1 to rounding."""


def fit_logistic(x: NDArray[np.floating], y: NDArray[np.bool_], start: Floats, strength: float) -> Floats:
    """Returns the weights that explain `y` by `sigmoid(x @ weights)`, found by Newton's method.

    Args:
        x: features, `[N, K]`.
        y: what happened, `[N]`.
        start: the weights that are believed before anything is seen, `[K]`.
        strength: of that belief: inverse variance of each weight around `start`.
    """
    target = y.astype(np.float64)
    weights = start.copy()
    for _ in range(NEWTON_STEPS):
        p = sigmoid(x @ weights)
        slope = x.T @ (p - target) + strength * (weights - start)
        curvature = (x * (p * (1.0 - p))[:, None]).T @ x + strength * np.eye(len(start))
        weights = weights - np.linalg.solve(curvature, slope)
    return weights


def sigmoid(logits: Floats) -> Floats:
    """Returns the sigmoid, without overflow."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(logits, -LIMIT, LIMIT))))
