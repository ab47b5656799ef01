"""Who is in a picture: the wanted person, and the others, who are occluders where they can hide part of them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.data.scene import PictureFiles
from occfusion.data.silhouette import bounding_box
from occfusion.errors import DataError
from occfusion.files.images import read_mask, read_numbers

Mask = NDArray[np.bool_]

GAP = 0.01
"""Of the person's size: segmenters leave a rim of this width between people who overlap; at least 2 pixels."""


def read_people(files: PictureFiles) -> tuple[Mask, Mask]:
    """Returns the visible wanted person and the other people who can hide part of them, bool `[H, W]` each.

    The second is empty where the masks do not number people: nobody else is known then.

    Raises:
        DataError: a mask is missing, damaged, of another size than the first, or cannot number people.
    """
    if files.label is None:
        person = _united([read_mask(path, any_value=files.any_value) for path in files.masks], files)
        return person, np.zeros_like(person)
    numbers = [read_numbers(path) for path in files.masks]
    person = _united([number == files.label for number in numbers], files)
    anybody = np.logical_or.reduce([number > 0 for number in numbers])
    return person, who_can_hide(person, anybody & ~person)


def who_can_hide(person: Mask, others: Mask) -> Mask:
    """Returns those of the other people who touch the visible person.

    A person is in one piece, so that a hidden part continues the visible one behind whoever begins at its edge;
    people who stand apart hide nothing. Groups that touch each other count as one.

    Args:
        person: visible pixels, bool `[H, W]`.
        others: visible pixels of everybody else, bool `[H, W]`.
    """
    if not (person.any() and others.any()):
        return np.zeros_like(others)
    gap = max(round(GAP * max(bounding_box(person)[2:])), 2)
    width = 2 * (gap + 1) + 1  # the pixel behind the rim is to be reached
    near = cv2.dilate(person.astype(np.uint8), np.ones((width, width), np.uint8)) > 0
    _, groups = cv2.connectedComponents(others.astype(np.uint8), connectivity=8)
    return np.asarray(np.isin(groups, np.unique(groups[near & others]))) & others


def _united(masks: list[Mask], files: PictureFiles) -> Mask:
    for mask, path in zip(masks, files.masks, strict=True):
        if mask.shape != masks[0].shape:
            raise DataError(
                f"{path}: its size differs from that of {files.masks[0]}; masks of a picture must have one size."
            )
    return np.asarray(np.logical_or.reduce(masks))
