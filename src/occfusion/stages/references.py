"""The references of the refinement stage: frames as the complete person, inpainted once and kept on disk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.errors import DataError
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


class References:
    """Reads inpainted frames when they are needed, and keeps them.

    Args:
        folder: with a picture and a region for each inpainted frame.
        frames: numbers of the frames that have one.
    """

    def __init__(self, folder: FrameFolder, frames: frozenset[int]) -> None:
        self.folder, self.frames = folder, frames
        self._read: dict[int, tuple[NDArray[np.uint8], NDArray[np.bool_]]] = {}

    def get(self, frame: Frame, box: Box) -> Reference | None:
        """Returns the reference of a frame inside `box`; None for a frame that needed none.

        Raises:
            DataError: a file is missing, or of another size than the frame.
        """
        if frame.index not in self.frames:
            return None
        if frame.index not in self._read:
            self._read[frame.index] = self._open(frame)
        rgb, region = (crop(torch.from_numpy(part), box) for part in self._read[frame.index])
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
