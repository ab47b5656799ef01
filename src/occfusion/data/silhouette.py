"""The person's outline in one picture, kept small: what occlusion is planned from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
        return np.unpackbits(self.bits, count=w * h).reshape(h, w).astype(bool)

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
