"""Gaussians in few bytes: the compressed `.ply` of PlayCanvas and SuperSplat, and `.spz`.

`.compressed.ply`: chunks of 256 Gaussians with their own bounds. The layout is that of playcanvas/engine
(`src/scene/gsplat/gsplat-compressed-data.js`), which reads it.

`.spz`, version 3: the layout of nianticlabs/spz (`src/cc/load-spz.cc`), packed with gzip. Version 3 is what most
readers take; version 4 is the same numbers behind zstd. Axes are right, up, back, which are those of our upright frame.
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
from occfusion.files.ply import Floats, SplatTable, check_table, comments

COMPRESSED_SUFFIX = ".compressed.ply"
CHUNK = 256
"""Gaussians that share bounds."""
_SH_C0 = 0.28209479177387814
_SH_RANGE = 4.0
"""Coefficients of higher bands are stored between minus this and this."""
_BOUNDS = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")


def write_compressed_ply(path: Path | str, table: SplatTable) -> None:
    """Writes the Gaussians whole or not at all, in an order that keeps neighbours together, 16 bytes each.

    Raises:
        DataError: a value is not finite, the arrays do not fit together, or the disk refuses.
    """
    rest = 3 * (check_table(path, table) - 1)
    n = len(table.means)
    order = _along_a_curve(table.means)
    values = [table.means, table.log_scales, table.sh0[:, 0] * np.float32(_SH_C0) + np.float32(0.5)]
    bounds, shares = zip(*(_within_chunks(value[order]) for value in values), strict=True)
    alphas = 1.0 / (1.0 + np.exp(-table.opacity_logits[order].astype(np.float64)))
    packed = np.stack(
        [
            _packed(shares[0], (11, 10, 11)),
            _rotations(table.raw_quats[order]),
            _packed(shares[1], (11, 10, 11)),
            _packed(np.concatenate([shares[2], alphas[:, None]], axis=1), (8, 8, 8, 8)),
        ],
        axis=1,
    )
    higher = table.sh_rest[order].transpose(0, 2, 1).reshape(n, rest)
    coefficients = np.clip(np.round((higher + _SH_RANGE) * (255 / (2 * _SH_RANGE))), 0, 255)
    header = ["ply", "format binary_little_endian 1.0", *comments(table)]
    header.append(f"element chunk {math.ceil(n / CHUNK)}")
    header += [
        f"property float {side}_{name}" for names in _BOUNDS for side in ("min", "max") for name in names
    ]
    header.append(f"element vertex {n}")
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if rest:
        header.append(f"element sh {n}")
        header += [f"property uchar f_rest_{k}" for k in range(rest)]
    content = "\n".join([*header, "end_header", ""]).encode("ascii")
    content += np.concatenate(bounds, axis=1).astype("<f4").tobytes() + packed.astype("<u4").tobytes()
    write_bytes(path, content + coefficients.astype(np.uint8).tobytes())


def _along_a_curve(means: Floats) -> NDArray[np.int64]:
    """Returns the order of the Gaussians along Morton's curve through their bounding box."""
    if not len(means):
        return np.zeros(0, np.int64)
    low, high = means.min(axis=0), means.max(axis=0)
    cells = ((means - low) / np.maximum(high - low, 1e-12) * 1023).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def _within_chunks(values: Floats) -> tuple[Floats, NDArray[np.float64]]:
    """Returns lower and upper bounds of each chunk `[C, 6]` and where each value lies between them, 0 to 1."""
    starts = np.arange(0, len(values), CHUNK)
    low, high = (
        np.minimum.reduceat(values, starts, axis=0) if len(values) else np.zeros((0, 3), np.float32),
        np.maximum.reduceat(values, starts, axis=0) if len(values) else np.zeros((0, 3), np.float32),
    )
    chunk = np.arange(len(values)) // CHUNK
    extent = (high - low).astype(np.float64)
    # values that are all the same have no extent: their share is 0
    share = (values - low[chunk]) / np.where(extent > 0.0, extent, 1.0)[chunk]
    return np.concatenate([low, high], axis=1), share


def _packed(shares: NDArray[np.float64], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """Returns numbers of 0 to 1 in one word each row, the first in the highest bits."""
    word = np.zeros(len(shares), np.uint32)
    for column, width in enumerate(bits):
        most = (1 << width) - 1
        part = np.clip(np.round(shares[:, column] * most), 0, most).astype(np.uint32)
        word = (word << np.uint32(width)) | part
    return word


def _rotations(raw_quats: Floats) -> NDArray[np.uint32]:
    """Returns rotations w, x, y, z as 2 bits for the largest and 10 bits for each other."""
    quats = raw_quats.astype(np.float64) / np.linalg.norm(raw_quats, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(axis=1)
    quats *= np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    others = quats[np.arange(4) != largest[:, None]].reshape(len(quats), 3)
    return (largest.astype(np.uint32) << 30) | _packed(others / math.sqrt(2) + 0.5, (10, 10, 10))


_SPZ_VERSION = 3
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
    header = struct.pack("<IIIBBBB", _MAGIC, _SPZ_VERSION, n, math.isqrt(bands) - 1, _FRACTION_BITS, 0, 0)
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
