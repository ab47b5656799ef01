"""Whether it is one person all through a clip, by the colours within the masks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from occfusion.errors import DataError

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

SIDE = 320
"""Pixels of the longer side in which colours are counted."""
CELLS, REACH = (6, 12, 12), (0, 256, 64, 192, 64, 192)
"""Of a histogram over lightness and the two axes of colour (CIE L*a*b* in bytes), and what it covers."""
COMPARED, SAMPLED = 80, 15
"""Pixels of the longer side, and frames of a clip, by which a camera that adapts is told: it changes the person and the
room alike."""
SOFTENED = 0.7
"""Cells by which colours are spread, standard deviation: shades and noise move them."""
FEWEST = 50
"""Pixels below which a mask tells nothing of colours."""
WHOLE = 0.35
"""Of the usual mask's size, below which a mask shows a part of the person, whose colours need not be all."""
WINDOW, BETWEEN = 3, 3
"""Frames before and after a change, and frames at most between them, in which masks may hold both people."""
AT_ONCE = 0.35
"""Seconds that a change takes at most: given longer, one person may have turned around."""
OTHER = 0.14
"""Distance from which on colours are of somebody else: 0 alike, 1 nothing in common."""
NEW, MORE = 0.1, 2.0
"""Share of the pixels, on either side of the change, whose colours the other side has not half as often: who is hidden
at once shows fewer colours than before, and no new ones."""
CLEARER = 2.0
"""How much farther apart frames before and after are than those on one side: who turns around changes all the time."""


def require_one_person(
    pictures: Sequence[Picture], masks: Sequence[Mask], numbers: Sequence[int], seconds: Sequence[float]
) -> None:
    """Raises DataError where from one moment on the mask is on somebody who is dressed otherwise.

    Two people who cross may be taken for each other, at a place that does not jump.

    Args:
        pictures: `[H, W, 3]`, RGB.
        masks: of the person, `[H, W]` each.
        numbers: each picture's place in the clip, for messages.
        seconds: time of each picture.
    """
    changes = first_of_another(pictures, masks, seconds)
    if not changes:
        return
    ends = [0, *changes, len(numbers)]
    longest = max(pairwise(ends), key=lambda part: part[1] - part[0])
    at = ", ".join(str(numbers[k]) for k in changes)
    raise DataError(
        f"somebody else seems to be followed from frame {at} on: the colours within the mask change at once. Give one "
        f"part alone; the longest: --start {numbers[longest[0]]} --stop {numbers[longest[1] - 1] + 1}. Or give masks "
        "of the person (--masks)."
    )


def first_of_another(
    pictures: Sequence[Picture], masks: Sequence[Mask], seconds: Sequence[float]
) -> list[int]:
    """Returns the pictures from which on the mask is on somebody else; none where it is one person all through.

    Args:
        pictures: `[H, W, 3]`, RGB.
        masks: of the person, `[H, W]` each.
        seconds: time of each picture.
    """
    gains = gains_of(pictures, masks)
    colours = [
        appearance(picture, mask, gain) for picture, mask, gain in zip(pictures, masks, gains, strict=True)
    ]
    sizes = np.array([0.0 if row is None else row.sum() for row in colours])
    told = np.flatnonzero(sizes > WHOLE * np.median(sizes)).tolist()
    changes = changes_of_person(np.array([colours[k] for k in told]), np.array([seconds[k] for k in told]))
    return [told[k] for k in changes]


def gains_of(pictures: Sequence[Picture], masks: Sequence[Mask]) -> Floats:
    """Returns how bright each picture is beside the others outside of the person, by channel, `[N, 3]`."""
    size = _fitting(masks[0], COMPARED)
    small = np.stack([cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures])
    small = small.astype(np.float32) + 1.0
    chosen = np.linspace(0, len(small) - 1, min(len(small), SAMPLED)).round().astype(int)
    ratios = small / np.median(small[chosen], axis=0)
    out = np.ones((len(small), 3))
    for k, mask in enumerate(masks):
        room = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) == 0
        if room.any():
            out[k] = np.median(ratios[k][room], axis=0)
    return out


def appearance(picture: Picture, mask: Mask, gain: Floats) -> Floats | None:
    """Returns how many pixels of a mask have each colour, `[C]`; None of too small a mask.

    Args:
        picture: `[H, W, 3]`, RGB.
        mask: `[H, W]`.
        gain: of the picture, `[3]`, which is taken out.
    """
    size = _fitting(mask, SIDE)
    person = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    inside = cv2.erode(person, np.ones((5, 5), np.uint8))
    if inside.sum() < FEWEST:
        return None
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    small = np.clip(small / gain, 0.0, 255.0).astype(np.uint8)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB)
    lab = np.clip(lab, REACH[::2], np.array(REACH[1::2]) - 1).astype(
        np.uint8
    )  # the most vivid count as vivid
    counts = np.reshape(cv2.calcHist([lab], [0, 1, 2], inside, list(CELLS), list(REACH)), CELLS)
    return np.asarray(gaussian_filter(counts.astype(np.float64), SOFTENED, mode="reflect").ravel())


def _fitting(mask: Mask, side: int) -> list[int]:
    """Returns width and height of a picture whose longer side is `side`."""
    return [max(1, round(length * side / max(mask.shape))) for length in mask.shape[::-1]]


def changes_of_person(colours: Floats, seconds: Floats) -> list[int]:
    """Returns the rows from which on another person is seen, none where it is one all through.

    Args:
        colours: of frames, `[N, C]`, see `appearance`.
        seconds: their times, `[N]`.
    """
    if len(colours) < 2 * WINDOW:
        return []
    roots = np.sqrt(colours / np.maximum(colours.sum(axis=1, keepdims=True), 1.0))
    apart = 1.0 - roots @ roots.T
    found: list[tuple[int, float, int]] = []
    for between in range(BETWEEN + 1):
        for k in range(WINDOW, len(colours) - WINDOW - between + 1):
            if seconds[k + between] - seconds[k - 1] > AT_ONCE:
                continue
            before, after = slice(k - WINDOW, k), slice(k + between, k + between + WINDOW)
            least = float(apart[before, after].min())
            within = max(float(apart[before, before].max()), float(apart[after, after].max()))
            if least > max(OTHER, CLEARER * within) and _new(colours[before], colours[after]) > NEW:
                found.append((between, -least, k + between))
    chosen: list[int] = []
    for _, _, row in sorted(found):  # of those that are one change the quickest, then the clearest
        if all(abs(row - other) > WINDOW + BETWEEN for other in chosen):
            chosen.append(row)
    return sorted(chosen)


def _new(before: Floats, after: Floats) -> float:
    """Returns the least share of pixels of new colours, of both directions and all pairs of `[W, C]` and `[W, C]`."""
    pairs = [(one, other) for one in before for other in after]
    shares = [
        min(np.maximum(a - MORE * b, 0.0).sum() / max(a.sum(), 1.0) for a, b in ((one, other), (other, one)))
        for one, other in pairs
    ]
    return float(min(shares))
