"""What a rendering of a crop is compared with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.geometry.boxes import crop
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


Backgrounds = Mapping[int, NDArray[np.bool_]]
"""By the numbers of the frames whose person is occluded: pixels taken for background, bool `[H, W]`."""


def mask_weights(
    frame: Frame, box: Box, backgrounds: Backgrounds, hidden: float, unseen: Tensor | None = None
) -> Tensor | None:
    """Returns how much each pixel of the window `box` counts in the mask term, `[h, w]`; None where all count fully.

    What is neither seen nor background has its place in a complete mask from a prior and a pose that may be off by
    more than the avatar is, which other frames show whole.

    Args:
        frame: a training frame.
        box: a window of it.
        backgrounds: of the occluded frames.
        hidden: weight of what is neither seen nor background.
        unseen: pixels of the window that no frame shows, which count fully: a complete mask is all there is to go by
            there; bool `[h, w]`.
    """
    background = backgrounds.get(frame.index)
    if background is None or hidden == 1.0:
        return None
    seen = crop(frame.visible_mask, box)
    known = seen | crop(torch.from_numpy(background), box).to(seen.device)
    return torch.where(known if unseen is None else known | unseen, 1.0, hidden)


def crop_frame(frame: Frame, box: Box) -> Target:
    """Returns the window `box` of a frame."""
    mask = frame.visible_mask if frame.complete_mask is None else frame.complete_mask
    return Target(crop(frame.rgb, box), crop(frame.visible_mask, box), crop(mask, box))
