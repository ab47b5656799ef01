"""Writing pictures as a video, as an animated picture, or as numbered files."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.atomic import atomic_write, folder_beside, numbered, put_in_place, write_png

CODECS = {".mp4": "mp4v", ".avi": "MJPG"}
ANIMATED = ".webp"
STILL = ".png"
SUFFIXES = (*CODECS, ANIMATED, STILL)
WEBP_QUALITY = 90
MOST_WEBP_PIXELS = 1_000_000_000
"""Of all pictures of an animated one together, which are kept in memory until it is written: 4 GB with alpha."""

Picture = NDArray[Any]


def check_destination(path: Path, *, alpha: bool = False) -> None:
    """Refuses a name that no writer is for, before anything is drawn.

    Args:
        path: a file, or a folder where it has no suffix.
        alpha: whether pictures have an alpha channel.

    Raises:
        DataError: an unknown suffix, a format without alpha where there is alpha, or a file where a folder should be.
    """
    suffix = path.suffix.lower()
    if suffix and suffix not in SUFFIXES:
        raise DataError(
            f"{path}: pictures are written as {', '.join(SUFFIXES)}; without a suffix, as .png files in a folder"
        )
    if alpha and suffix in CODECS:
        raise DataError(f"{path}: {suffix} has no transparency; write .webp, or .png files in a folder")
    if not suffix and path.exists() and not path.is_dir():
        raise DataError(f"{path} is a file; name a folder for .png files")


def write_frames(path: Path, pictures: Iterable[Picture], fps: float) -> int:
    """Writes pictures, whole or not at all; returns how many.

    Args:
        path: `.mp4`, `.avi`, animated `.webp`, `.png` of one picture, or a folder for `NNNN.png` without a suffix.
            A video's odd sizes get their last row or column twice, since codecs halve the colour planes.
        pictures: uint8 `[H, W, 3]`, for `.webp` and `.png` also `[H, W, 4]`, for `.png` also `[H, W]` and uint16.
        fps: frames a second.

    Raises:
        DataError: a suffix that is not supported, no picture, a missing codec, or a file that cannot be written.
    """
    check_destination(path)
    suffix = path.suffix.lower()
    stream = iter(pictures)
    first = next(stream, None)
    if first is None:
        raise DataError(f"{path}: there is no picture to write")
    every = itertools.chain([first], stream)
    if suffix == "":
        return write_folder(path, ([picture] for picture in every), [""])
    if suffix == STILL:
        if next(stream, None) is not None:
            raise DataError(f"{path}: a .png holds one picture; ask for one frame, or name a folder")
        write_png(path, first)
        return 1
    return _write_webp(path, every, fps) if suffix == ANIMATED else _write_video(path, every, fps)


def write_folder(path: Path, pictures: Iterable[Sequence[Picture]], names: Sequence[str]) -> int:
    """Writes numbered `.png` files, all or none; returns how many a folder has.

    Numbered files of an earlier call give way, other files stay.

    Args:
        path: the folder.
        pictures: as many at a time as there are names.
        names: folders within it, one for each; an empty one is the folder itself.

    Raises:
        DataError: the disk refuses.
    """
    count = 0
    with folder_beside(path) as folder:
        for count, row in enumerate(pictures, 1):
            for name, picture in zip(names, row, strict=True):
                write_png(folder / name / numbered(count - 1, STILL), picture)
        for name in names if count else ():
            put_in_place(folder / name, path / name, STILL, count)
    return count


def _write_video(path: Path, pictures: Iterator[Picture], fps: float) -> int:
    """The codec writes a file of its own; it takes its place when it is whole."""
    count = 0
    with folder_beside(path) as folder:
        partial = folder / f"film{path.suffix.lower()}"
        writer: cv2.VideoWriter | None = None
        try:
            for picture in pictures:
                height, width = picture.shape[:2]
                even = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                if writer is None:
                    writer = _open(path, partial, fps, (even.shape[1], even.shape[0]))
                writer.write(cv2.cvtColor(even, cv2.COLOR_RGB2BGR))
                count += 1
        finally:
            if writer is not None:
                writer.release()
        if not partial.is_file() or partial.stat().st_size == 0:
            raise DataError(f"{path}: the codec wrote nothing; try .webp or a folder of .png files")
        partial.replace(path)
    return count


def _open(path: Path, partial: Path, fps: float, size: tuple[int, int]) -> cv2.VideoWriter:
    code = CODECS[path.suffix.lower()]
    writer = cv2.VideoWriter(str(partial), cv2.VideoWriter.fourcc(*code), fps, size)
    if not writer.isOpened():
        raise DataError(
            f"{path}: this OpenCV has no codec {code} for {size[0]} x {size[1]} pixels; write .webp, or .png files in "
            "a folder"
        )
    return writer


def _write_webp(path: Path, pictures: Iterator[Picture], fps: float) -> int:
    from PIL import Image

    kept, pixels = [], 0
    for picture in pictures:
        pixels += picture.shape[0] * picture.shape[1]
        if pixels > MOST_WEBP_PIXELS:
            raise DataError(
                f"{path}: an animated picture of more than {MOST_WEBP_PIXELS:,} pixels in all does not fit in memory; "
                "write .mp4, or .png files into a folder"
            )
        kept.append(Image.fromarray(picture))
    with atomic_write(path) as stream:
        kept[0].save(
            stream, "WEBP", save_all=True, append_images=kept[1:], duration=round(1000 / fps), loop=0,
            quality=WEBP_QUALITY, method=2,
        )  # fmt: skip
    return len(kept)
