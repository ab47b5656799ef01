"""What a rendering of a crop is compared with."""

from __future__ import annotations

from dataclasses import dataclass

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


def crop_frame(frame: Frame, box: Box) -> Target:
    """Returns the window `box` of a frame."""
    mask = frame.visible_mask if frame.complete_mask is None else frame.complete_mask
    return Target(crop(frame.rgb, box), crop(frame.visible_mask, box), crop(mask, box))
