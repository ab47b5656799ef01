"""Writing pictures as a video or as numbered files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.atomic import write_png

VIDEO_SUFFIXES = (".mp4", ".avi")
CODECS = {".mp4": "mp4v", ".avi": "MJPG"}


def write_frames(path: Path, pictures: Iterable[NDArray[np.uint8]], fps: float) -> None:
    """Writes `[H, W, 3]` 8-bit RGB pictures to a video, or to `NNNN.png` in a folder when `path` has no suffix.

    Odd sizes are padded by one black row or column, since video codecs halve the colour planes.

    Raises:
        DataError: a suffix that is not supported, or a file that cannot be written.
    """
    if path.suffix == "":
        path.mkdir(parents=True, exist_ok=True)
        for number, picture in enumerate(pictures):
            write_png(path / f"{number:04d}.png", picture)
        return
    if path.suffix not in VIDEO_SUFFIXES:
        raise DataError(
            f"{path}: videos are written as {' or '.join(VIDEO_SUFFIXES)}; without a suffix, as .png files"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    writer: cv2.VideoWriter | None = None
    try:
        for picture in pictures:
            height, width = picture.shape[:2]
            even = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)))
            if writer is None:
                code = cv2.VideoWriter.fourcc(*CODECS[path.suffix])
                writer = cv2.VideoWriter(str(path), code, fps, (even.shape[1], even.shape[0]))
                if not writer.isOpened():
                    raise DataError(
                        f"{path}: the video cannot be opened for writing; try a folder of .png files"
                    )
            writer.write(cv2.cvtColor(even, cv2.COLOR_RGB2BGR))
    finally:
        if writer is not None:
            writer.release()
