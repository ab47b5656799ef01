"""The camera of a clip: as given, as its EXIF says, or as most cameras are."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import ConfigError

USUAL_FOCAL = 1.0
"""Focal length against the longer side where nothing is known: 36 mm on film, between a phone's 26 and 50 mm."""
_FILM_WIDTH = 36.0
_EXIF_POINTER, _FOCAL_35 = 0x8769, 0xA405


@dataclass(frozen=True)
class Intrinsics:
    """A camera without distortion.

    Attributes:
        K: intrinsics, `[3, 3]`, pixels, the middle of the first pixel is 0.5.
        known: whether the focal length was given or measured, not guessed.
        source: where it comes from, in words.
    """

    K: NDArray[np.float64]
    known: bool
    source: str


def find_intrinsics(
    size: tuple[int, int], scale: float, focal: float | None, picture: Path | None
) -> Intrinsics:
    """Returns the camera of a clip, the principal point in the middle.

    Args:
        size: width and height of the decoded pictures, pixels.
        scale: pixels of these a pixel of the file.
        focal: pixels of the file; None for what `picture` says, else a guess.
        picture: a file of the folder, whose EXIF may say it; None for a video.

    Raises:
        ConfigError: the focal length cannot be.
    """
    longer = max(size)
    if focal is not None:
        if not 0.2 * longer < focal * scale < 20 * longer:
            raise ConfigError(
                f"--focal {focal:g}: no focal length of pictures with a longer side of {longer / scale:.0f}."
            )
        return Intrinsics(_matrix(focal * scale, size), True, f"--focal {focal:g}")
    if picture is not None and (film := focal_on_film(picture)) is not None:
        return Intrinsics(
            _matrix(film / _FILM_WIDTH * longer, size), True, f"EXIF of {picture.name}: {film:g} mm on film"
        )
    return Intrinsics(
        _matrix(USUAL_FOCAL * longer, size), False,
        f"guessed, {USUAL_FOCAL:g} x the longer side; the fit may move it (--focal PIXELS if you know it)",
    )  # fmt: skip


def _matrix(focal: float, size: tuple[int, int]) -> NDArray[np.float64]:
    return np.array([[focal, 0.0, size[0] / 2], [0.0, focal, size[1] / 2], [0.0, 0.0, 1.0]])


def focal_on_film(path: Path) -> float | None:
    """Returns EXIF's FocalLengthIn35mmFilm of a JPEG, millimetres; None where it has none (EXIF 2.32, tag 0xA405)."""
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        return None
    with path.open("rb") as stream:
        head = stream.read(1 << 16)
    at = head.find(b"Exif\0\0")
    if at < 0:
        return None
    block = head[at + 6 :]
    order = {b"II": "<", b"MM": ">"}.get(block[:2])
    try:
        if order is None:
            return None
        (first,) = struct.unpack_from(order + "I", block, 4)
        pointer = _entry(block, order, first, _EXIF_POINTER)
        value = None if pointer is None else _entry(block, order, pointer, _FOCAL_35)
    except struct.error:
        return None
    return float(value) if value else None


def _entry(block: bytes, order: str, start: int, tag: int) -> int | None:
    (count,) = struct.unpack_from(order + "H", block, start)
    for index in range(count):
        at = start + 2 + 12 * index
        found, kind = struct.unpack_from(order + "HH", block, at)
        if found == tag:
            return int(struct.unpack_from(order + ("H" if kind == 3 else "I"), block, at + 8)[0])
    return None
