"""Complete masks that the data set itself knows: the upper bound of what a prior can give."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.priors.masks import MaskPrior, Observation


class TruthMasks(MaskPrior):
    """Answers with the true masks of synthetic frames.

    Args:
        masks: bool `[H, W]` by the name of the frame.
    """

    name = "truth"

    def __init__(self, masks: Mapping[str, NDArray[np.bool_]]) -> None:
        self._masks = masks

    def describe(self) -> dict[str, Any]:
        """Returns that it is the truth."""
        return {"prior": self.name}

    def probability(self, observation: Observation) -> NDArray[np.float32]:
        """Returns 1 where the person is, 0 elsewhere."""
        return self._masks[observation.name].astype(np.float32)
