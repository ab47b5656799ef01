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
        return Intrinsics(centred(focal * scale, size), True, f"--focal {focal:g}")
    if picture is not None and (film := focal_on_film(picture)) is not None:
        return Intrinsics(
            centred(film / _FILM_WIDTH * longer, size), True, f"EXIF of {picture.name}: {film:g} mm on film"
        )
    return Intrinsics(
        centred(USUAL_FOCAL * longer, size), False,
        f"guessed, {USUAL_FOCAL:g} x the longer side; the fit may move it (--focal PIXELS if you know it)",
    )  # fmt: skip


def pinhole(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    """Returns intrinsics `[3, 3]` of focal lengths and a principal point, pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def centred(focal: float, size: tuple[float, float]) -> NDArray[np.float64]:
    """Returns intrinsics `[3, 3]` of a focal length in pixels, the middle of a picture `size` being its centre."""
    return pinhole(focal, focal, size[0] / 2, size[1] / 2)


def focal_on_film(path: Path) -> float | None:
    """Returns EXIF's FocalLengthIn35mmFilm of a JPEG, millimetres; None where it has none (EXIF 2.32, tag 0xA405)."""
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        return None
    with path.open("rb") as stream:
        head = stream.read(1 << 16)
    from PIL.Image import Exif

    tags = Exif()
    try:
        tags.load(head[head.index(b"Exif\0\0") :])
        return float(tags.get_ifd(_EXIF_POINTER)[_FOCAL_35]) or None
    except (
        KeyError,
        SyntaxError,
        TypeError,
        ValueError,
        struct.error,
    ):  # there are none, or they are damaged
        return None
