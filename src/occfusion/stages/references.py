"""The references of the refinement stage: frames as the complete person, inpainted once and kept on disk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.data.silhouette import bounding_box
from occfusion.data.views import BoundedCache
from occfusion.errors import DataError
from occfusion.fields.bits import Packed, packed, unpacked
from occfusion.files.images import read_mask, read_rgb
from occfusion.files.run_folder import FrameFolder
from occfusion.geometry.boxes import crop
from occfusion.types import Box, Frame


@dataclass(frozen=True)
class Reference:
    """A window of an inpainted frame.

    Attributes:
        rgb: the complete person over black, `[h, w, 3]`, 0..1.
        region: pixels that it is a reference for: the paper's R or what of it no frame shows, bool `[h, w]`.
    """

    rgb: Tensor
    region: Tensor


MOST_KEPT = 128_000_000
"""Bytes of inpainted frames that are kept; beyond that they are read each time."""


@dataclass(frozen=True)
class _Kept:
    """An inpainted frame without the black about the person.

    Attributes:
        rgb: inside `box`, `[h, w, 3]`.
        box: of what is not black.
        region: packed.
    """

    rgb: NDArray[np.uint8]
    box: Box
    region: Packed

    @classmethod
    def of(cls, rgb: NDArray[np.uint8], region: NDArray[np.bool_]) -> _Kept:
        box = bounding_box(
            (rgb[..., 0] | rgb[..., 1] | rgb[..., 2]) != 0
        )  # a tenth of `any` over three numbers
        x, y, w, h = box
        return cls(rgb[y : y + h, x : x + w].copy(), box, packed(region))

    @property
    def nbytes(self) -> int:
        """Bytes of both."""
        return self.rgb.nbytes + len(self.region[0])

    def whole(self) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Returns picture and region of the frame."""
        region, (x, y, w, h) = unpacked(self.region), self.box
        rgb = np.zeros((*region.shape, 3), dtype=np.uint8)
        rgb[y : y + h, x : x + w] = self.rgb
        return rgb, region


class References:
    """Reads inpainted frames when they are needed, and keeps them while there is room.

    Args:
        folder: with a picture and a region for each inpainted frame.
        frames: numbers of the frames that have one.
    """

    def __init__(self, folder: FrameFolder, frames: frozenset[int]) -> None:
        self.folder, self.frames = folder, frames
        self._read: BoundedCache[_Kept] = BoundedCache(MOST_KEPT)

    def get(self, frame: Frame, box: Box) -> Reference | None:
        """Returns the reference of a frame inside `box`; None for a frame that needed none.

        Raises:
            DataError: a file is missing, or of another size than the frame.
        """
        if frame.index not in self.frames:
            return None
        kept = self._read.get(frame.index, lambda: _Kept.of(*self._open(frame)))
        rgb, region = (crop(torch.from_numpy(part), box) for part in kept.whole())
        return Reference(rgb.to(frame.rgb) / 255.0, region.to(frame.rgb.device))

    def _open(self, frame: Frame) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        path = self.folder.picture(frame.index)
        region_path = self.folder.second_picture(frame.index)
        for file in (path, region_path):
            if not file.is_file():
                raise DataError(
                    f"{file}: the reference of this frame is missing; remove {self.folder.path} to make all anew"
                )
        rgb, region = read_rgb(path), read_mask(region_path)
        height, width = frame.rgb.shape[:2]
        if rgb.shape[:2] != (height, width) or region.shape != (height, width):
            raise DataError(
                f"{path}: {rgb.shape[1]} x {rgb.shape[0]} pixels, but frames have {width} x {height}"
            )
        return rgb, region
