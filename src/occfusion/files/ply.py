"""Gaussians as the `.ply` of 3DGS: binary little-endian, float32, raw values (log-scales, logits, SH)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.atomic import write_bytes

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class SplatTable:
    """Gaussians as they are stored, one row each, float32.

    Attributes:
        means: centres, `[N, 3]`, metres.
        raw_quats: rotations w, x, y, z, `[N, 4]`, of any length.
        log_scales: natural logarithms of the standard deviations in metres, `[N, 3]`.
        opacity_logits: `[N]`.
        sh0: coefficients of band 0, `[N, 1, 3]`.
        sh_rest: coefficients of the other bands, `[N, K - 1, 3]`.
        about: what a file says of itself where its format has room for words: one line, ASCII.
    """

    means: Floats
    raw_quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh0: Floats
    sh_rest: Floats
    about: str = ""


def write_ply(path: Path | str, table: SplatTable) -> None:
    """Writes the Gaussians whole or not at all; bands that are not stored are not padded.

    Raises:
        DataError: a value is not finite, the arrays do not fit together, or the disk refuses.
    """
    n, rest = len(table.means), check_table(path, table) - 1
    columns = np.concatenate(
        [
            table.means,
            np.zeros((n, 3), np.float32),  # normals: part of the layout, without meaning
            table.sh0.reshape(n, 3),
            table.sh_rest.transpose(0, 2, 1).reshape(n, 3 * rest),  # all of red, then green, then blue
            table.opacity_logits[:, None],
            table.log_scales,
            table.raw_quats,
        ],
        axis=1,
    ).astype("<f4")
    names = [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{k}" for k in range(3 * rest)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    header = ["ply", "format binary_little_endian 1.0", *comments(table), f"element vertex {n}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    write_bytes(path, "\n".join(header).encode("ascii") + columns.tobytes())


def comments(table: SplatTable) -> list[str]:
    """Returns the lines of a header that say what the file is; none where nobody said."""
    return [f"comment {table.about}"] if table.about else []


def check_table(path: Path | str, table: SplatTable) -> int:
    """Returns how many coefficients of harmonics a colour has; `path` is where the table shall go.

    Raises:
        DataError: a value is not finite, or the arrays do not fit together.
    """
    n = len(table.means)
    rest = table.sh_rest.shape[1] if table.sh_rest.ndim == 3 else -1
    shapes = {
        "means": (n, 3), "raw_quats": (n, 4), "log_scales": (n, 3),
        "opacity_logits": (n,), "sh0": (n, 1, 3), "sh_rest": (n, rest, 3),
    }  # fmt: skip
    for name, shape in shapes.items():
        value = getattr(table, name)
        if value.shape != shape:
            raise DataError(f"{path}: {name} has shape {value.shape}, expected {shape}")
        _check_finite(path, name, value)
    return rest + 1


def _check_finite(path: Path | str, name: str, value: Floats) -> None:
    bad = ~np.isfinite(value.reshape(len(value), math.prod(value.shape[1:]))).all(axis=1)
    if bad.any():
        raise DataError(
            f"{path}: {name} is not finite in {int(bad.sum())} rows, the first is row {int(bad.argmax())}"
        )
