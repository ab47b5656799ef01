"""Completing masks: what a prior is given of a frame, and what it returns (paper §4.1)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import NumericsError
from occfusion.observation.frames import Observation


class MaskPrior(ABC):
    """An interface: completes the mask of a partly hidden person."""

    name: str

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Returns all that decides its answers, for the manifest: plain numbers and text."""

    @abstractmethod
    def probability(self, observation: Observation) -> NDArray[np.float32]:
        """Returns how probable each pixel is to show the person, if nothing hid it, `[H, W]`, 0..1."""


def checked_probability(prior: MaskPrior, observation: Observation) -> NDArray[np.float32]:
    """Returns a prior's answer with what is known put in: 1 where the person is seen, 0 on known background.

    Raises:
        NumericsError: the prior returned a value that is not finite, or a picture of another size.
    """
    raw = prior.probability(observation)
    if raw.shape != observation.visible.shape:
        raise NumericsError(
            f"prior {prior.name}, frame {observation.name}: a mask of {raw.shape[1]} x {raw.shape[0]} pixels for a "
            f"picture of {observation.visible.shape[1]} x {observation.visible.shape[0]}"
        )
    if not np.isfinite(raw).all():
        raise NumericsError(
            f"prior {prior.name}, frame {observation.name}: {int((~np.isfinite(raw)).sum())} pixels of its mask are "
            f"not finite; the masks finished before stay. With prior=sd15 try prior.dtype=float32"
        )
    return with_what_is_known(np.clip(raw, 0.0, 1.0), observation)


def with_what_is_known(probability: NDArray[np.float32], observation: Observation) -> NDArray[np.float32]:
    """Returns a probability `[H, W]` set to 1 where the person is seen and to 0 on known background."""
    known = np.where(observation.visible, 1.0, probability)
    return np.where(observation.background & ~observation.visible, 0.0, known).astype(np.float32)


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
