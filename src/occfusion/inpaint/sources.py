"""References that no prior paints: the coarse rendering as it is, and the truth of synthetic scenes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.inpaint.partial import Inpainter, Partial, Picture


class CoarsePictures(Inpainter):
    """Leaves the hidden part as the coarse avatar shows it: what refinement gains without inpainting."""

    name = "coarse"

    def describe(self) -> dict[str, Any]:
        """Returns the name."""
        return {"inpainter": self.name}

    def inpaint(self, partial: Partial) -> Picture:
        """Returns the coarse rendering."""
        return partial.coarse


class TruthPictures(Inpainter):
    """Shows what the occluder hides: an upper bound.

    Args:
        pictures: the unoccluded person of each frame by the frame's name, `[H, W, 3]`, 0..1.
    """

    name = "truth"

    def __init__(self, pictures: Mapping[str, NDArray[np.float32]]) -> None:
        self._pictures = pictures

    def describe(self) -> dict[str, Any]:
        """Returns the name."""
        return {"inpainter": self.name}

    def inpaint(self, partial: Partial) -> Picture:
        """Returns the true picture."""
        return self._pictures[partial.observation.name]
