"""Masks that are kept as arrays, `.npy`, as InstantAvatar's preparation of PeopleSnapshot writes them.

Numbers only: nothing in such a file is executed. True and false, whole numbers from 0 to 65535, or a share of
the person from 0 to 1 as floating-point numbers, which counts as a soft mask of 255 steps.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.arrays import load_npy, npy_form

SUFFIX = ".npy"

_KINDS = "biuf"
_LARGEST = 65535


def is_mask_array(path: Path | str) -> bool:
    """Returns whether a mask is kept as an array, told from its name."""
    return Path(path).suffix.lower() == SUFFIX


def mask_array_size(path: Path | str) -> tuple[int, int]:
    """Returns (width, height) in pixels, reading only the beginning of the file.

    Raises:
        DataError: missing, damaged, or no picture of numbers.
    """
    shape, dtype = npy_form(path)
    plane = shape[:2] if len(shape) == 3 and shape[2] == 1 else shape
    if len(plane) != 2 or 0 in plane or dtype.kind not in _KINDS:
        raise DataError(
            f"{path}: holds {dtype} of shape {shape}; a mask is [height, width], true and false or numbers."
        )
    return plane[1], plane[0]


def read_mask_array(path: Path | str, max_megapixels: float) -> NDArray[Any]:
    """Returns the values of a mask, uint8 or uint16 `[H, W]`.

    Args:
        path: the file.
        max_megapixels: larger masks are refused before they are read.

    Raises:
        DataError: missing, damaged, too large, no picture of numbers, or values that no mask has.
    """
    width, height = mask_array_size(path)
    if width * height > max_megapixels * 1e6:
        raise DataError(
            f"{path}: declares {width} x {height} pixels, more than {max_megapixels:g} megapixels; scale it down first."
        )
    values = np.asarray(load_npy(path)).reshape(height, width)
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if not np.isfinite(values).all() or values.min() < 0 or values.max() > _LARGEST:
        raise DataError(f"{path}: a mask has no values below 0, above {_LARGEST}, infinite or NaN.")
    whole = values.dtype.kind in "iu" or bool((values == np.round(values)).all())
    if not whole:
        if values.max() > 1:
            raise DataError(
                f"{path}: fractions up to {float(values.max()):g}; write 0 to 1 as the share of the person."
            )
        values = np.round(values * 255)
    return values.astype(np.uint8 if values.max() < 256 else np.uint16)
