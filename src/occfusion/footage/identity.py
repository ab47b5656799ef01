"""Whether it is one person all through a clip, by the colours within the masks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

SIDE = 320
"""Pixels of the longer side in which colours are counted."""
CELLS, REACH = (6, 12, 12), (0, 256, 64, 192, 64, 192)
"""Of a histogram over lightness and the two axes of colour (CIE L*a*b* in bytes), and what it covers."""
GREY = 110.0
"""What the room's median is made, of 255: a camera that adapts changes the person and the room alike."""
FEWEST = 50
"""Pixels below which a mask tells nothing of colours."""
WINDOW, BETWEEN = 3, 3
"""Frames before and after a change, and frames at most between them, in which masks may hold both people."""
AT_ONCE = 0.35
"""Seconds that a change takes at most: given longer, one person may have turned around."""
OTHER = 0.22
"""Distance from which on colours are of somebody else: 0 alike, 1 nothing in common."""
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
    colours = [appearance(picture, mask) for picture, mask in zip(pictures, masks, strict=True)]
    told = [k for k, row in enumerate(colours) if row is not None]
    if not (
        changes := changes_of_person(
            np.array([colours[k] for k in told]), np.array([seconds[k] for k in told])
        )
    ):
        return
    ends = [0, *(told[k] for k in changes), len(numbers)]
    longest = max(pairwise(ends), key=lambda part: part[1] - part[0])
    at = ", ".join(str(numbers[told[k]]) for k in changes)
    raise DataError(
        f"somebody else seems to be followed from frame {at} on: the colours within the mask change at once. Give one "
        f"part alone; the longest: --start {numbers[longest[0]]} --stop {numbers[longest[1] - 1] + 1}. Or give masks "
        "of the person (--masks)."
    )


def appearance(picture: Picture, mask: Mask) -> Floats | None:
    """Returns how often each colour is in a mask, as square roots of shares `[C]`; None of too small a mask."""
    size = [max(1, round(length * SIDE / max(mask.shape))) for length in mask.shape[::-1]]
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    person = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    inside = cv2.erode(person, np.ones((5, 5), np.uint8))
    if inside.sum() < FEWEST:
        return None
    room = cv2.dilate(person, np.ones((9, 9), np.uint8)) == 0
    if room.any():
        level = np.maximum(np.median(small[room], axis=0), 10.0)
        small = np.clip(small * (GREY / level), 0.0, 255.0).astype(np.uint8)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB)
    counts = cv2.calcHist([lab], [0, 1, 2], inside, list(CELLS), list(REACH)).reshape(CELLS[0], -1)
    # along lightness alone: shades count less than colours
    rows = cv2.GaussianBlur(counts, (1, 3), 0).ravel().astype(np.float64)
    return np.asarray(np.sqrt(rows / max(rows.sum(), 1.0)))


def changes_of_person(colours: Floats, seconds: Floats) -> list[int]:
    """Returns the rows from which on another person is seen, none where it is one all through.

    Args:
        colours: of frames, `[N, C]`, see `appearance`.
        seconds: their times, `[N]`.
    """
    apart = 1.0 - colours @ colours.T if len(colours) else np.zeros((0, 0))
    found: dict[int, float] = {}
    for between in range(BETWEEN + 1):
        for k in range(WINDOW, len(colours) - WINDOW - between + 1):
            if seconds[k + between] - seconds[k - 1] > AT_ONCE:
                continue
            before, after = slice(k - WINDOW, k), slice(k + between, k + between + WINDOW)
            least = float(apart[before, after].min())
            within = max(float(apart[before, before].max()), float(apart[after, after].max()))
            if least > max(OTHER, CLEARER * within):
                found[k + between] = max(least, found.get(k + between, 0.0))
    chosen: list[int] = []
    for row in sorted(found, key=lambda row: -found[row]):  # the clearest of those that are one change
        if all(abs(row - other) > WINDOW + BETWEEN for other in chosen):
            chosen.append(row)
    return sorted(chosen)
