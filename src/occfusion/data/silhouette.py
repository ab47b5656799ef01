"""The person's outline in one picture, kept small, and the other people in it, who may be occluders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.data.scene import PictureFiles
from occfusion.errors import DataError
from occfusion.fields.bits import mask_of_bits
from occfusion.files.images import read_mask, read_numbers
from occfusion.types import Box


@dataclass(frozen=True)
class Silhouette:
    """A mask as bits inside its bounding box.

    Attributes:
        width: columns of the picture.
        height: rows of the picture.
        box: bounding box of the person; `(0, 0, 0, 0)` when there is none.
        bits: the mask inside the box, packed.
    """

    width: int
    height: int
    box: Box
    bits: NDArray[np.uint8]

    @classmethod
    def of(cls, mask: NDArray[np.bool_]) -> Silhouette:
        """Returns the silhouette of a mask `[H, W]`."""
        box = bounding_box(mask)
        x, y, w, h = box
        return cls(mask.shape[1], mask.shape[0], box, np.packbits(mask[y : y + h, x : x + w]))

    @property
    def empty(self) -> bool:
        """Whether nobody is in the picture."""
        return self.box[2] == 0

    def crop(self) -> NDArray[np.bool_]:
        """Returns the mask inside the box."""
        _, _, w, h = self.box
        return mask_of_bits(self.bits, (h, w))

    def columns(self) -> NDArray[np.int64]:
        """Returns the person's pixels in each column of the picture, `[W]`."""
        counts = np.zeros(self.width, dtype=np.int64)
        x, _, w, _ = self.box
        counts[x : x + w] = self.crop().sum(axis=0)
        return counts

    def full(self) -> NDArray[np.bool_]:
        """Returns the mask of the whole picture, `[H, W]`."""
        mask = np.zeros((self.height, self.width), dtype=bool)
        x, y, w, h = self.box
        mask[y : y + h, x : x + w] = self.crop()
        return mask

    def share_outside(self, hidden: Hidden | None) -> float:
        """Returns the share of the person's pixels that lie outside a rectangle or another mask."""
        mask = self.crop()
        total = int(mask.sum())
        if hidden is None or total == 0:
            return 1.0
        if isinstance(hidden, Silhouette):
            x, y, w, h = self.box
            return 1.0 - int((mask & hidden.full()[y : y + h, x : x + w]).sum()) / total
        x, y, _, _ = self.box
        left, top = max(hidden[0] - x, 0), max(hidden[1] - y, 0)
        right, bottom = max(hidden[0] + hidden[2] - x, 0), max(hidden[1] + hidden[3] - y, 0)
        return 1.0 - int(mask[top:bottom, left:right].sum()) / total


Hidden = Box | Silhouette
"""What is hidden of a stored picture: a rectangle, or the true pixels of a mask of its size."""


def bounding_box(mask: NDArray[np.bool_]) -> Box:
    """Returns the smallest rectangle around the true pixels; `(0, 0, 0, 0)` when there are none."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if rows.size == 0:
        return 0, 0, 0, 0
    x, y = int(columns[0]), int(rows[0])
    return x, y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1


def require_size(size: tuple[int, int], path: Path, wanted: tuple[int, int]) -> None:
    """Raises DataError unless a file has the (width, height) of its camera's other pictures."""
    if size != wanted:
        raise DataError(
            f"{path}: {size[0]} x {size[1]} pixels, but this camera's pictures have {wanted[0]} x {wanted[1]}; "
            "pictures and masks must have one size."
        )


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
