"""One decoded moment, kept small: bytes inside the person's box, masks as bits."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.data.cameras import Lens
from occfusion.data.scene import PictureFiles
from occfusion.data.silhouette import Hidden, Silhouette, bounding_box, read_people, require_size
from occfusion.errors import DataError
from occfusion.fields import bits
from occfusion.files.images import read_mask, read_rgb
from occfusion.types import Box

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Packed:
    """A moment at frame size. The person is cut out, so nothing outside `box` needs to be kept.

    Attributes:
        size: (width, height) of the frame.
        box: around the person, hidden parts included.
        seen: the picture inside the box, black outside the visible mask, `[h, w, 3]`; None where it is
            `whole` with the hidden pixels blackened.
        whole: the unoccluded picture inside the box, black outside the complete mask; None if not known.
        visible: bits of the visible mask inside the box.
        complete: bits of the complete mask inside the box.
        hidden: the occluded pixels of the whole frame, packed, other people's included; None where nothing is.
        certain: whether `hidden` is all that is occluded; not where real occluders are unknown.
    """

    size: tuple[int, int]
    box: Box
    seen: Bytes | None
    whole: Bytes | None
    visible: Bytes
    complete: Bytes
    hidden: bits.Packed | None
    certain: bool = True

    @property
    def nbytes(self) -> int:
        """Bytes of all that is kept."""
        parts = (self.seen, self.whole, self.visible, self.complete)
        hidden = 0 if self.hidden is None else len(self.hidden[0])
        return hidden + sum(part.nbytes for part in parts if part is not None)

    # Tensors are made by NumPy: PyTorch would start its thread pool anew in the thread that reads ahead,
    # and compete with the training step for the cores.

    def visible_mask(self) -> Tensor:
        """Returns the visible mask of the frame, bool `[H, W]`."""
        return self._mask(self.visible)

    def rgb(self) -> Tensor:
        """Returns the observation, `[H, W, 3]`, 0..1, black outside the visible mask."""
        if self.seen is not None:
            return self._colours(self.seen)
        assert self.whole is not None  # one of the two is always kept
        return self._colours(_blacken(self.whole, self._unpack(self.visible)))

    def truth(self) -> tuple[Tensor, Tensor] | None:
        """Returns (rgb, mask) of the unoccluded person, None where it is not known."""
        return None if self.whole is None else (self._colours(self.whole), self._mask(self.complete))

    def occluded(self) -> Tensor | None:
        """Returns the pixels that an occluder hides, bool `[H, W]`; None where that is not known."""
        if not self.certain:
            return None
        if self.hidden is None:
            return torch.zeros(self.size[::-1], dtype=torch.bool)
        return torch.from_numpy(bits.unpacked(self.hidden))

    def _unpack(self, kept: Bytes) -> Mask:
        _, _, w, h = self.box
        return bits.mask_of_bits(kept, (h, w))

    def _mask(self, bits: Bytes) -> Tensor:
        x, y, w, h = self.box
        frame = np.zeros(self.size[::-1], dtype=bool)
        frame[y : y + h, x : x + w] = self._unpack(bits)
        return torch.from_numpy(frame)

    def _colours(self, crop: Bytes) -> Tensor:
        x, y, w, h = self.box
        frame = np.zeros((*self.size[::-1], 3), dtype=np.float32)
        np.multiply(crop, np.float32(1 / 255), out=frame[y : y + h, x : x + w])
        return torch.from_numpy(frame)


def pack(
    files: PictureFiles, lens: Lens, hidden_part: Hidden | None = None, *, clean: bool = False
) -> Packed:
    """Returns one moment, read from disk, cut out, undistorted and scaled.

    The cut is made at the stored size, so that edge pixels are the person blended onto black by coverage;
    what then lies outside the mask at frame size is set to black.

    Args:
        files: where it lies.
        lens: its camera.
        hidden_part: simulated occlusion in pixels of the stored picture.
        clean: a held-out view: the unoccluded picture is the observation.

    Raises:
        DataError: a file is missing or damaged, or its size is not that of the camera's other pictures.
    """
    observed, hiders = read_people(files)
    require_size(observed.shape[::-1], files.masks[0], lens.source)
    crowded = files.complete_mask is None and bool(hiders.any())
    unknown = files.truth_unknown or crowded
    whole_path: Path | None
    if files.complete_mask is None:  # nothing stood before the person, or nobody knows what it hid
        whole_path, whole_mask = (None if unknown else files.rgb), observed
    else:
        whole_path, whole_mask = files.complete_rgb, read_mask(files.complete_mask)
        require_size(whole_mask.shape[::-1], files.complete_mask, lens.source)
    whole = None if whole_path is None else _cut(whole_path, whole_mask, lens)
    complete = lens.mask(whole_mask)
    if clean and whole is None and not unknown:
        raise DataError(f"{files.rgb}: a held-out view needs the picture without its occluder beside it.")
    seen, visible, hidden = None, complete, None
    if unknown or (not clean and files.complete_mask is not None):
        seen, visible = _cut(files.rgb, observed, lens), lens.mask(observed)
    if not clean and files.complete_mask is not None:
        hidden = complete & ~visible
    if crowded:  # where others stand is known, but not what of the person is behind them
        hidden = lens.hidden(Silhouette.of(hiders)) & ~visible
    if hidden_part is not None:
        simulated = lens.hidden(hidden_part)
        hidden = simulated if hidden is None else hidden | simulated
        visible = visible & ~simulated
    box = bounding_box(complete | visible)
    x, y, w, h = box
    window = (slice(y, y + h), slice(x, x + w))
    return Packed(
        size=lens.size,
        box=box,
        seen=None if seen is None else _blacken(seen[window], visible[window]),
        whole=None if whole is None else _blacken(whole[window], complete[window]),
        visible=np.packbits(visible[window]),
        complete=np.packbits(complete[window]),
        hidden=None if hidden is None else bits.packed(hidden),
        certain=not files.truth_unknown,
    )


def _cut(path: Path, mask: Mask, lens: Lens) -> Bytes:
    picture = read_rgb(path)
    require_size(picture.shape[1::-1], path, lens.source)
    return lens.picture(_blacken(picture, mask))


def _blacken(picture: Bytes, mask: Mask) -> Bytes:
    """Returns the picture where the mask is true, black elsewhere."""
    if picture.size == 0:
        return picture
    picture = np.ascontiguousarray(picture)
    return np.asarray(cv2.bitwise_and(picture, picture, mask=mask.astype(np.uint8)))
