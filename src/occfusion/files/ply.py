"""Gaussians as the `.ply` of 3DGS: binary little-endian, float32, raw values (log-scales, logits, SH)."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.atomic import write_bytes

Floats = NDArray[np.float32]

MAX_HEADER = 65_536
"""Bytes; the longest header that this layout needs is below 2000."""


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
    names = _property_names(3 * rest)
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


def read_ply(path: Path | str) -> SplatTable:
    """Returns the Gaussians of a 3DGS `.ply`; its float properties may stand in any order.

    Raises:
        DataError: missing, damaged, another layout, or a value is not finite.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from error
    count, names, start = _parse_header(path, content)
    width = len(names)
    if len(content) - start != 4 * count * width:
        raise DataError(
            f"{path}: {len(content) - start} bytes follow the header, {count} Gaussians of {width} numbers "
            f"take {4 * count * width}; the file is cut off or holds more than Gaussians"
        )
    values = np.frombuffer(content, "<f4", offset=start).reshape(count, width)
    rest = sum(name.startswith("f_rest_") for name in names)
    missing = [name for name in _property_names(rest) if name not in names and name not in ("nx", "ny", "nz")]
    bands = math.isqrt(rest // 3 + 1)
    if missing or rest % 3 or bands**2 != rest // 3 + 1:
        raise DataError(f"{path}: no 3DGS layout; missing {missing}, {rest} properties f_rest_*")

    def take(*wanted: str) -> Floats:
        columns = values[:, [names.index(name) for name in wanted]].astype(np.float32)
        _check_finite(path, ", ".join(wanted[:3]), columns)
        return columns

    higher = take(*(f"f_rest_{k}" for k in range(rest))) if rest else np.zeros((count, 0), np.float32)
    return SplatTable(
        means=take("x", "y", "z"),
        raw_quats=take("rot_0", "rot_1", "rot_2", "rot_3"),
        log_scales=take("scale_0", "scale_1", "scale_2"),
        opacity_logits=take("opacity")[:, 0],
        sh0=take("f_dc_0", "f_dc_1", "f_dc_2")[:, None],
        sh_rest=np.ascontiguousarray(higher.reshape(count, 3, rest // 3).transpose(0, 2, 1)),
    )


def _property_names(rest: int) -> list[str]:
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{k}" for k in range(rest)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]


def _parse_header(path: Path, content: bytes) -> tuple[int, list[str], int]:
    """Returns the number of Gaussians, their properties in order, and where the numbers start."""
    end = re.search(rb"\nend_header\r?\n", content[:MAX_HEADER])
    if not content.startswith(b"ply") or end is None:
        raise DataError(f"{path}: not a .ply file")
    lines = [line.strip() for line in content[: end.start()].decode("ascii", "replace").splitlines()[1:]]
    lines = [line for line in lines if line and not line.startswith(("comment", "obj_info"))]
    if not lines or lines[0] != "format binary_little_endian 1.0":
        raise DataError(f"{path}: only binary little-endian .ply files are read")
    element = re.fullmatch(r"element vertex (\d{1,12})", lines[1] if len(lines) > 1 else "")
    properties = [re.fullmatch(r"property (?:float|float32) (\w+)", line) for line in lines[2:]]
    names = [match.group(1) for match in properties if match is not None]
    if element is None or len(names) != len(properties) or len(set(names)) != len(names):
        raise DataError(f"{path}: expected one element `vertex` of distinct float properties")
    return int(element.group(1)), names, end.end()


def _check_finite(path: Path | str, name: str, value: Floats) -> None:
    bad = ~np.isfinite(value.reshape(len(value), math.prod(value.shape[1:]))).all(axis=1)
    if bad.any():
        raise DataError(
            f"{path}: {name} is not finite in {int(bad.sum())} rows, the first is row {int(bad.argmax())}"
        )
