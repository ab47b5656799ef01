"""What a rendering of a crop is compared with."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.geometry.boxes import crop
from occfusion.observation.frames import ObservedFrames
from occfusion.types import Box, Frame


@dataclass(frozen=True)
class Target:
    """A frame's window.

    Attributes:
        rgb: the observation, black where the person is not seen, `[h, w, 3]`.
        visible_mask: the paper's M, bool `[h, w]`.
        mask: what the occupancy map is to become: M-hat where a stage made it, else M; bool `[h, w]`.
    """

    rgb: Tensor
    visible_mask: Tensor
    mask: Tensor


Masks = Mapping[int, NDArray[np.bool_]]
"""By the numbers of frames, one mask of the frame each, bool `[H, W]`."""


@dataclass(frozen=True)
class UncertainMasks:
    """Where complete masks may be wrong; frames that show a whole person have none.

    Attributes:
        hidden: what neither shows the person nor is background for certain.
        assumed_background: what of that was taken for background when masks were completed, or all of it where a frame
            is given no complete mask: what stands there in its place says nothing.
    """

    hidden: Masks = field(default_factory=dict)
    assumed_background: Masks = field(default_factory=dict)

    @classmethod
    def found(
        cls, observed_frames: ObservedFrames, completed: Collection[int] | None = None
    ) -> UncertainMasks:
        """Returns where masks and poses of the training frames leave complete masks uncertain, when that is asked.

        Args:
            observed_frames: of all training frames, in order.
            completed: positions of those that are given complete masks; None: of all, or no stage makes any.
        """

        def assumed_background(position: int, hidden: NDArray[np.bool_]) -> NDArray[np.bool_]:
            is_asked = completed is None or position in completed
            return hidden & observed_frames[position].evidence.background if is_asked else hidden

        return cls(_Uncertain(observed_frames), _Uncertain(observed_frames, assumed_background))

    def of(self, frame: Frame, box: Box, unseen: Tensor | None = None) -> Tensor | None:
        """Returns the uncertain pixels of a window but those of `unseen`, bool `[h, w]`; None for a whole person."""
        found = _window(self.hidden, frame, box)
        return found if found is None or unseen is None else found & ~unseen


class _Uncertain(Mapping[int, NDArray[np.bool_]]):
    """Masks of the frames that leave something uncertain; each is made when it is asked for.

    Args:
        observed_frames: of all training frames, in order.
        part: gives the mask, by a position and what may be hidden there; None: all that may be.
    """

    def __init__(
        self,
        observed_frames: ObservedFrames,
        part: Callable[[int, NDArray[np.bool_]], NDArray[np.bool_]] | None = None,
    ) -> None:
        self._frames, self._part = observed_frames, part

    def __getitem__(self, frame: int) -> NDArray[np.bool_]:
        position = self._frames.positions[frame]
        hidden = self._frames[position].evidence.maybe_hidden
        if not hidden.any():
            raise KeyError(frame)
        return hidden if self._part is None else self._part(position, hidden)

    def __iter__(self) -> Iterator[int]:
        return (frame for frame in self._frames.indices if frame in self)

    def __len__(self) -> int:
        return sum(1 for _ in self)


def mask_weights(
    frame: Frame, box: Box, uncertain: UncertainMasks, hidden: float, unseen: Tensor | None = None
) -> Tensor | None:
    """Returns how much each pixel of the window `box` counts in the mask term, `[h, w]`; None where all count fully.

    What is hidden has its place in a complete mask from a prior and a pose that may be off by more than the avatar is,
    which other frames show whole.

    Args:
        frame: a training frame.
        box: a window of it.
        uncertain: of all frames.
        hidden: weight of the uncertain pixels; below 1, those that no prior was asked about count for nothing.
        unseen: pixels of the window that no frame shows, which count fully: a complete mask is all there is to go by
            there; bool `[h, w]`.
    """
    uncertain_pixels = uncertain.of(frame, box, unseen)
    if uncertain_pixels is None or hidden == 1.0:
        return None
    weights = torch.where(uncertain_pixels, hidden, 1.0)
    assumed_background = _window(uncertain.assumed_background, frame, box)
    if assumed_background is None:
        return weights
    return torch.where(assumed_background & uncertain_pixels, 0.0, weights)


def with_outline(
    mask: Tensor,
    frame: Frame,
    box: Box,
    uncertain: UncertainMasks,
    outlines: Masks,
    unseen: Tensor | None = None,
) -> Tensor:
    """Returns a window's complete mask, with an avatar's outline where that is in doubt, bool `[h, w]`.

    Args:
        mask: the complete mask of the window, bool `[h, w]`.
        frame: a training frame.
        box: a window of it.
        uncertain: of all frames.
        outlines: the avatar's; in a frame without one the complete mask stays.
        unseen: see `mask_weights`; the complete mask stays there.
    """
    outline, uncertain_pixels = _window(outlines, frame, box), uncertain.of(frame, box, unseen)
    return (
        mask if outline is None or uncertain_pixels is None else torch.where(uncertain_pixels, outline, mask)
    )


def _window(masks: Masks, frame: Frame, box: Box) -> Tensor | None:
    whole = masks.get(frame.index)
    return None if whole is None else crop(torch.from_numpy(whole), box).to(frame.visible_mask.device)


def crop_frame(frame: Frame, box: Box) -> Target:
    """Returns the window `box` of a frame."""
    mask = frame.visible_mask if frame.complete_mask is None else frame.complete_mask
    return Target(crop(frame.rgb, box), crop(frame.visible_mask, box), crop(mask, box))
