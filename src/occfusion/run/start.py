"""What precedes the optimisation: the colours that its Gaussians start with."""

from __future__ import annotations

import time

from occfusion.data.module import HumanDataModule
from occfusion.data.sampling import spread
from occfusion.human import Avatar
from occfusion.human.rendering import Renderer
from occfusion.inpaint.accumulation import accumulate, paint_observed

FRAMES = 200
"""At most, of those that are looked at."""
OPACITY = 0.95
"""Of discs on the body that are to hide what lies behind them."""


def start_as_observed(avatar: Avatar, data: HumanDataModule, renderer: Renderer) -> float:
    """Gives the Gaussians of a body the colours that the video shows there; returns the seconds that it took.

    Those that hardly any frame shows get the colours of what is seen nearby. Begun grey, they would stay it, and
    shine through in every frame that hides their like.

    Args:
        avatar: before training, its Gaussians on the body; changed in place.
        data: whose training frames.
        renderer: draws the avatar.
    """
    started = time.monotonic()
    frames = (data.train_frame(k, truth=False) for k in spread(len(data.train_indices), FRAMES))
    paint_observed(avatar, accumulate(avatar.eval(), frames, renderer, OPACITY))
    return time.monotonic() - started
