"""The pictures of in-context inpainting: a complete person beside a partly hidden one, and the way back (§4.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.inpaint.partial import Mask, Partial, Picture
from occfusion.observation.keypoints import Keypoints
from occfusion.priors.sd15.canvas import draw_keypoints
from occfusion.priors.sd15.region import Region

HALVES = 2


@dataclass(frozen=True)
class SideBySide:
    """What is inpainted: left the person as rendered, right as seen; each half `[h, w]`, multiples of 8.

    Attributes:
        picture: both on white, `[h, 2 w, 3]`, 0..1.
        mask: pixels to paint, bool `[h, 2 w]`; none of the left half.
    """

    picture: Picture
    mask: Mask


def put_side_by_side(partial: Partial, region: Region) -> SideBySide:
    """Returns the coarse rendering and the observation, of a region at work.

    A pixel at work is painted if any part of it belongs to the paper's R: else the white of what is not seen would
    be read back as the person's colour where the picture is resized.
    """
    visible = partial.observation.visible[..., None]
    seen = np.where(visible, partial.observation.rgb, 1.0).astype(np.float32)
    left = region.take(_on_white(partial), outside=1.0)
    right = region.take(seen, outside=1.0)
    hidden = region.take(partial.region.astype(np.float32), outside=0.0) > 0.0
    picture = np.clip(np.concatenate([left, right], axis=1), 0.0, 1.0)
    return SideBySide(picture, np.concatenate([np.zeros_like(hidden), hidden], axis=1))


def draw_side_by_side(seen: Keypoints, region: Region) -> NDArray[np.uint8]:
    """Returns the skeleton of a region at work, drawn in both halves, `[h, 2 w, 3]`, 0..255.

    The lines are as thick as those of the whole canvas; what leaves a half is cut off, not continued in the other.
    """
    half = draw_keypoints(seen, HALVES * region.work_width, region.work_height)[:, : region.work_width]
    return np.concatenate([half] * HALVES, axis=1)


def right_half(picture: Picture) -> Picture:
    """Returns the right half of a picture `[h, 2 w, C]`."""
    return picture[:, picture.shape[1] // HALVES :]


def put_back(painted: Picture | None, partial: Partial, region: Region | None) -> Picture:
    """Returns the complete person over black, `[H, W, 3]`, 0..1.

    Visible pixels are those of the observation; the paper's R inside the region is painted; what remains of the
    complete mask, and what R has outside the region, is the coarse rendering; the rest is black. Of what is painted
    the white that the coarse occupancy lets through is taken away, so that a painter who copies the left half
    returns the coarse rendering.

    Args:
        painted: the right half at work, over white, `[h, w, 3]`; NaN where it is not finite; None: nothing was.
        partial: the frame.
        region: where it was painted; None: nowhere.
    """
    visible = partial.observation.visible[..., None]
    person = (partial.complete | partial.region)[..., None]
    known = np.where(visible, partial.observation.rgb, np.where(person, partial.coarse, 0.0))
    if painted is None or region is None:
        return known.astype(np.float32)
    height, width = partial.alpha.shape
    over_black = region.put(painted, width, height) - (1.0 - partial.alpha[..., None])
    chosen = partial.region & region.inside(width, height)
    return np.where(chosen[..., None], np.clip(over_black, 0.0, 1.0), known).astype(np.float32)


def _on_white(partial: Partial) -> Picture:
    """Returns the coarse rendering over white, `[H, W, 3]`."""
    return (partial.coarse + (1.0 - partial.alpha[..., None])).astype(np.float32)
