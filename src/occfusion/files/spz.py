"""Gaussians as `.spz`, version 3: the layout of nianticlabs/spz (`src/cc/load-spz.cc`), packed with gzip.

Version 3 is what most readers take; version 4 is the same numbers behind zstd. Axes are right, up, back, which are
those of our upright frame.
"""

from __future__ import annotations

import gzip
import math
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.atomic import write_bytes
from occfusion.files.ply import SplatTable, check_table

VERSION = 3
_MAGIC = 0x5053474E
_FRACTION_BITS = 16
"""Of the 24 of a coordinate: steps of 15 micrometres, up to 128 m."""
_COLOR_SCALE = 0.15
_SCALE_OFFSET, _SCALE_STEPS = 10.0, 16.0
_QUAT_MAGNITUDE = 511


def write_spz(path: Path | str, table: SplatTable) -> None:
    """Writes the Gaussians whole or not at all, quantised as the format has it.

    Raises:
        DataError: a value is not finite or too far away, the arrays do not fit together, or the disk refuses.
    """
    bands = check_table(path, table)
    n = len(table.means)
    fixed = np.round(table.means.astype(np.float64) * 2**_FRACTION_BITS).astype(np.int64)
    if n and np.abs(fixed).max() >= 2**23:
        raise DataError(f"{path}: .spz holds places up to {2 ** (23 - _FRACTION_BITS)} m from the origin")
    positions = (fixed[:, :, None] >> np.array([0, 8, 16])) & 0xFF
    alphas = 255.0 / (1.0 + np.exp(-table.opacity_logits.astype(np.float64)))
    parts = [
        positions.astype(np.uint8),
        _byte(alphas),
        _byte(table.sh0 * (_COLOR_SCALE * 255.0) + 127.5),
        _byte((table.log_scales + _SCALE_OFFSET) * _SCALE_STEPS),
        _smallest_three(table.raw_quats).astype("<u4"),
        _byte(table.sh_rest * 128.0 + 128.0),
    ]
    header = struct.pack("<IIIBBBB", _MAGIC, VERSION, n, math.isqrt(bands) - 1, _FRACTION_BITS, 0, 0)
    write_bytes(path, gzip.compress(header + b"".join(part.tobytes() for part in parts), 9, mtime=0))


def _byte(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _smallest_three(raw_quats: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Returns rotations w, x, y, z as 2 bits for the largest of x, y, z, w and 10 bits for each other."""
    quats = np.roll(raw_quats.astype(np.float64), -1, axis=1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(axis=1)
    quats *= np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    magnitudes = np.minimum(np.round(_QUAT_MAGNITUDE * math.sqrt(2) * np.abs(quats)), _QUAT_MAGNITUDE)
    words = magnitudes.astype(np.uint32) | ((quats < 0).astype(np.uint32) << 9)
    packed = largest.astype(np.uint32)
    for axis in range(4):
        packed = np.where(largest == axis, packed, (packed << 10) | words[:, axis])
    return packed
