"""Intrinsics that other tools measured.

| form | written by |
|---|---|
| `cameras.npz`: `intrinsic`, `width`, `height` | this program, InstantAvatar |
| `transforms.json`: `fl_x` .. `h`, or `camera_angle_x` | nerfstudio `process_data/colmap_utils.py`; instant-ngp |
| `cameras.txt`, or its folder | COLMAP's text, colmap/colmap `doc/format.rst` |
| `.json` with `fx`, `fy`, `cx`, `cy`, or a 3 x 3 matrix | calibration programs |

Bodies are fitted in the camera, frame by frame: where a camera stands is not asked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.arrays import load_npz
from occfusion.files.jsonfile import load_json
from occfusion.footage.camera import Intrinsics, centred, pinhole
from occfusion.footage.clip import Shot

Floats = NDArray[np.float64]

_MATRICES = ("K", "intrinsic", "intrinsics", "intrinsic_matrix", "camera_matrix")
_DISTORTED = 0.02
"""Coefficients of the lens from here on are said: pictures are taken as they are."""


def read_intrinsics(path: Path, shot: Shot) -> tuple[Intrinsics, list[str]]:
    """Returns the camera for the pictures of a shot, and what a user should know.

    Raises:
        DataError: missing, damaged, of no known form, or for pictures of another shape.
    """
    if path.is_dir():
        path = path / "cameras.txt"
    if not path.is_file():
        raise DataError(f"{path}: no such file.")
    suffix = path.suffix.lower()
    if suffix == ".npz":
        K, size, lens = _npz(path)
    elif suffix == ".txt":
        K, size, lens = _colmap(path)
    elif suffix == ".json":
        K, size, lens = _json(path)
    else:
        raise DataError(
            f"{path}: cameras are read from .npz, .json and COLMAP's cameras.txt. One of weak perspective has no focal "
            "length: give it with the bodies that it draws (--from vibe, --from 4d-humans)."
        )
    scale = np.full(2, shot.scale)
    if size is not None:
        scale = np.array(shot.size) / np.array(size)
        if abs(scale[0] / scale[1] - 1) > 0.02:
            raise DataError(
                f"{path}: is for pictures of {size[0]:g} x {size[1]:g}, these have the shape {shot.size[0]} x "
                f"{shot.size[1]}."
            )
    K = np.diag([*scale, 1.0]) @ K
    if not (np.isfinite(K).all() and 0.1 * max(shot.size) < K[0, 0] < 50 * max(shot.size)):
        raise DataError(
            f"{path}: a focal length of {K[0, 0]:g} px is none for pictures of {shot.size[0]} px."
        )
    notes = []
    if max(map(abs, lens), default=0.0) > _DISTORTED:
        notes.append(
            f"{path.name} says that the lens bends lines ({lens[0]:.3g} ...); the pictures are taken as they are. "
            "Undistort them first."
        )
    return Intrinsics(K, True, path.name), notes


Read = tuple[Floats, tuple[float, float] | None, list[float]]


def _npz(path: Path) -> Read:
    content = load_npz(path, ("intrinsic", "width", "height", "pixel_centres"))
    if "intrinsic" not in content or np.shape(content["intrinsic"])[-2:] != (3, 3):
        raise DataError(f"{path}: has no intrinsic of 3 x 3 numbers.")
    K = np.asarray(content["intrinsic"], dtype=np.float64).reshape(-1, 3, 3)[0].copy()
    K[:2, 2] += 0.5 - float(content.get("pixel_centres", 0.5))
    size = None
    if "width" in content and "height" in content:
        size = float(content["width"]), float(content["height"])
    return K, size, []


_COLMAP = {"SIMPLE_PINHOLE": 1, "PINHOLE": 2, "SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2, "FULL_OPENCV": 2}
"""Models that are read, and how many focal lengths stand first."""


def _colmap(path: Path) -> Read:
    """Reads `CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]`; of several cameras the median."""
    rows, sizes = [], set()
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            focals = _COLMAP[words[1]]
            values = [float(word) for word in words[4:]]
            if len(values) < focals + 2:
                raise IndexError("numbers are missing")
            f = [values[0], values[focals - 1]]
            rows.append([*f, *values[focals : focals + 2], *values[focals + 2 : focals + 3]])
            sizes.add((float(words[2]), float(words[3])))
        except (KeyError, IndexError, ValueError) as error:
            raise DataError(
                f"{path}, line {number}: no camera of {', '.join(_COLMAP)}; COLMAP writes CAMERA_ID MODEL WIDTH HEIGHT "
                "PARAMS[] (model_converter --output_type TXT)."
            ) from error
    if not rows or len(sizes) > 1:
        raise DataError(f"{path}: {'has no camera' if not rows else 'has cameras of several sizes'}.")
    middle = [float(np.median([row[k] for row in rows if len(row) > k])) for k in range(max(map(len, rows)))]
    return pinhole(*middle[:4]), sizes.pop(), middle[4:]


def _json(path: Path) -> Read:
    content = load_json(path)
    if not isinstance(content, Mapping):
        raise DataError(f"{path}: holds a {type(content).__name__}, not a camera.")
    frames = content.get("frames")
    if isinstance(frames, list) and frames and isinstance(frames[0], Mapping):
        content = {**frames[0], **content}  # nerfstudio lays intrinsics that differ into the frames
    try:
        return _said(content, path)
    except (TypeError, ValueError, KeyError) as error:
        raise DataError(f"{path}: no intrinsics ({error}).") from error


def _said(content: Mapping[str, Any], path: Path) -> Read:
    width, height = content.get("w", content.get("width")), content.get("h", content.get("height"))
    size = None if width is None or height is None else (float(width), float(height))
    lens = [float(content[k]) for k in ("k1", "k2", "k3", "p1", "p2") if content.get(k) is not None]
    if "fl_x" in content:
        middle = [float(content[k]) if k in content else None for k in ("cx", "cy")]
        if size is None and None in middle:
            raise ValueError("fl_x without cx, cy, w, h")
        cx, cy = (m if m is not None else size[k] / 2 for k, m in enumerate(middle))  # type: ignore[index]
        fx = float(content["fl_x"])
        return pinhole(fx, float(content.get("fl_y", fx)), cx, cy), size, lens
    if "camera_angle_x" in content:
        if size is None:
            raise ValueError("camera_angle_x without w and h: add the pictures' size")
        f = 0.5 * size[0] / math.tan(0.5 * float(content["camera_angle_x"]))
        return centred(f, size), size, lens
    # calibration programs count the middle of the first pixel as 0
    if "fx" in content:
        fx = float(content["fx"])
        return pinhole(fx, float(content.get("fy", fx)), content["cx"] + 0.5, content["cy"] + 0.5), size, lens
    key = next((key for key in _MATRICES if key in content), None)
    if key is None:
        raise ValueError(
            f"none of fl_x, fx, camera_angle_x, {', '.join(_MATRICES)}; it has {', '.join(content)}"
        )
    value = content[key]
    K = np.asarray(value.get("data") if isinstance(value, Mapping) else value, dtype=np.float64)
    if K.size != 9:
        raise ValueError(f"{key} has {K.size} numbers, expected 9")
    K = K.reshape(3, 3)
    K = K.T.copy() if K[2, 0] > 1 else K.copy()  # Open3D writes columns
    K[:2, 2] += 0.5
    return K, size, lens
