"""A few views, evenly spread: for curves and pictures."""

from __future__ import annotations

from occfusion.data.module import HumanDataModule
from occfusion.data.sampling import spread
from occfusion.types import Frame


def held_out_handful(data: HumanDataModule, wanted: int) -> list[Frame]:
    """Returns evenly spread held-out views; they go round the cameras and through time."""
    views = data.test_views
    return [data.test_frame(*views[k]) for k in spread(len(views), wanted)]


def training_handful(data: HumanDataModule, wanted: int) -> list[Frame]:
    """Returns evenly spread training views with their truth."""
    return [data.train_frame(k) for k in spread(len(data.train_indices), wanted)]
