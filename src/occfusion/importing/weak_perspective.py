"""Cameras of weak perspective, by which many tools say where a person is: a scale and a shift, and no distance.

A point of the body is drawn at `s (x + t)`, in shares of half the picture from its middle; how deep it lies does not
matter. No camera that we render with does that, but one far away with a long lens nearly does: it is off by the depth
over the distance, under one percent of the way from the middle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError

Floats = NDArray[np.float64]

LENS = 5000.0 / 224.0
"""Focal length against the longer side: what these tools suppose of their 224 px inputs when they need one."""
LONG_LENS = "its camera supposes a very long lens, so that the person stands far away."


def centred(focal: float, size: tuple[int, int]) -> Floats:
    """Returns intrinsics `[3, 3]` of a focal length in pixels, the middle of a picture `size` being its centre."""
    return np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])


def places(cameras: Floats, size: tuple[int, int], where: str) -> tuple[Floats, Floats]:
    """Returns intrinsics `[3, 3]` and places of the body `[N, 3]`, metres, that draw it as weak perspective does.

    Args:
        cameras: `[N, 4]`: scales along x and y, in halves of the picture a metre, then shifts, metres.
        size: width and height of the picture, pixels.
        where: the file, for messages.

    Raises:
        DataError: a scale is none, or the two are of another picture's shape.
    """
    scales, shifts = cameras[:, :2], cameras[:, 2:]
    metre = scales * np.array(size) / 2  # pixels
    with np.errstate(invalid="ignore"):
        wrong = ~(metre > 1e-3).all(axis=1) | ~(np.abs(metre[:, 0] / metre[:, 1] - 1) < 0.02)
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        x, y = metre[row]
        raise DataError(
            f"{where}, row {row}: a metre of {x:g} x {y:g} px is none in pictures of {size[0]} x {size[1]}: is "
            "the file of this clip?"
        )
    K = centred(LENS * max(size), size)
    return K, np.column_stack([shifts, K[0, 0] / metre[:, 0]])
