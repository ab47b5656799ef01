"""Completing masks: what a prior is given of a frame, and what it returns (paper §4.1)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import NumericsError
from occfusion.types import Camera

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Observation:
    """A frame as a prior sees it.

    Attributes:
        name: what errors call it.
        rgb: the person as far as seen, black elsewhere, float32 `[H, W, 3]`, 0..1.
        visible: the paper's M, bool `[H, W]`.
        background: pixels known to show no person, bool `[H, W]`.
        camera: the camera.
        vertices: the body mesh in the world, `[V, 3]`, metres.
        keypoints: its key points in the world, `[18, 3]`, metres.
        faces: its triangles, `[F, 3]`.
    """

    name: str
    rgb: NDArray[np.float32]
    visible: Mask
    background: Mask
    camera: Camera
    vertices: NDArray[np.float64]
    keypoints: NDArray[np.float64]
    faces: NDArray[np.int64]


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
