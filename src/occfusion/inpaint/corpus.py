"""What the inpainter learns from: coarse avatars of training subjects in the frames that they were trained on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.human.avatar import Avatar
from occfusion.inpaint.accumulation import accumulate, paint_unseen
from occfusion.inpaint.partial import take_partial
from occfusion.inpaint.planes import DEPTH, take_picture, take_planes
from occfusion.priors.moments import Moment
from occfusion.types import Frame


@dataclass(frozen=True)
class Example:
    """A partly hidden person, coarse avatar and truth, in the crop.

    Attributes:
        planes: of `PLANES`, uint8 `[15, S, S]`; depth is moved by one before it is scaled.
        truth: the person over black, uint8 `[3, S, S]`.
        mask: share of each pixel that the person covers, uint8 `[S, S]`.
    """

    planes: NDArray[np.uint8]
    truth: NDArray[np.uint8]
    mask: NDArray[np.uint8]


def make_examples(
    avatar: Avatar, frames: Sequence[Frame], moments: Sequence[Moment], backend: str
) -> Iterator[Example]:
    """Yields an example for each occluded frame, whose truth must be known.

    Args:
        avatar: of the end of the optimisation stage; what no frame shows of it is given the colours of what is seen
            nearby, as the refinement does before it asks for references.
        frames: all training frames, with the complete masks that the avatar was trained with.
        moments: of the same frames.
        backend: rasteriser backend.
    """
    accumulated = accumulate(avatar, frames, backend)
    paint_unseen(avatar, accumulated)
    for frame, moment in zip(frames, moments, strict=True):
        if not moment.evidence.occluded:
            continue
        assert frame.truth is not None
        observation = moment.observation(frame, avatar.body)
        square, planes = take_planes(take_partial(avatar, accumulated, frame, observation, backend))
        planes[DEPTH] = 0.5 * (planes[DEPTH] + 1.0)
        mask = frame.truth.mask.numpy().astype(np.float32)[..., None]
        truth = take_picture(square, np.concatenate([frame.truth.rgb.numpy(), mask], axis=-1))
        yield Example(_bytes(planes), _bytes(truth[:3]), _bytes(truth[3]))


def _bytes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.round(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8)


def as_floats(example: Example) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Returns planes, truth and mask of an example, or of windows of one, as they were."""
    planes = example.planes.astype(np.float32) / 255.0
    planes[DEPTH] = 2.0 * planes[DEPTH] - 1.0
    return planes, example.truth.astype(np.float32) / 255.0, example.mask.astype(np.float32) / 255.0
