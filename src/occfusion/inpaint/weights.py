"""Weights of the embedded inpainter."""

from __future__ import annotations

from pathlib import Path

from occfusion.inpaint.network import AppearanceNet
from occfusion.inpaint.planes import SIZE
from occfusion.priors.weights import Card, load_net

APPEARANCE = "appearance"
VERSION = 2
"""Of what the network is told and predicts: 2 since its signal is companded."""


def load_appearance_net(path: str | Path | None = None) -> tuple[AppearanceNet, Card]:
    """Returns the network of the embedded inpainter, ready to evaluate, and its card; see `priors.weights.load_net`."""
    return load_net(path, APPEARANCE, SIZE, AppearanceNet, "prior.inpaint.weights", VERSION)
