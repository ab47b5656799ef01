"""Body poses over time in one file, under the names that programs give them, in the convention of smplx.

| program | file | content |
|---|---|---|
| smplx's names: InstantAvatar | `.npz` | `global_orient` N x 3, `body_pose` N x 69, `transl` N x 3, `betas` |
| InstantAvatar's PeopleSnapshot | `.npz` | `thetas` N x 72, `transl` N x 3, `betas` 10 |
| InstantAvatar's dances | `.npz` | `poses` N x 72, `trans` N x 3, no `betas` |
| AMASS (SMPL-H) | `.npz` | `poses` N x 156, `trans` N x 3, `betas` 16, `gender`, `mocap_framerate`, `dmpls` |
| AMASS (SMPL-X) | `.npz` | `poses` N x 165, `trans`, `betas` 16, `gender`, `mocap_frame_rate`, `surface_model_type` |
| AIST++ | `.pkl` | `smpl_poses` N x 72 or N x 24 x 3, `smpl_trans` N x 3 in centimetres, `smpl_scaling` |

Of SMPL-H and SMPL-X the pelvis and the 21 joints up to the wrists are SMPL's; hands, face and soft tissue are
left out. AIST++ scales the body and then shifts it, `x = s M(pose) + t`: seen from a body of SMPL's own size
that is `x / s = M(pose) + t / s`, and so its translation is divided by `smpl_scaling`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from occfusion.data.checking import checks
from occfusion.data.folder_contents import need
from occfusion.data.scene import Array
from occfusion.errors import DataError
from occfusion.files.arrays import load_npz
from occfusion.files.unpickle import load_pickle

WIDTHS = {"global_orient": 3, "body_pose": 69, "transl": 3}
SMPL_NUMBERS, SMPLH_NUMBERS, SMPLX_NUMBERS = 72, 156, 165
THETAS = "thetas, as InstantAvatar prepares PeopleSnapshot"
"""The form that only this program writes."""

_SHARED = 66
"""Numbers of SMPL-H and SMPL-X that are SMPL's: the pelvis and the 21 joints up to the wrists."""

_RATES = ("mocap_framerate", "mocap_frame_rate")
"""How AMASS calls the frames a second: in its SMPL-H release, and in that of SMPL-X."""

_KEYS = (*WIDTHS, "thetas", "poses", "trans", "betas", "surface_model_type", *_RATES)
_AIST_RATE = 60.0

_CLEAR = 0.7
"""Mean share of an axis in the body's own upward direction from which that axis counts as up; 45 degrees."""


@dataclass(frozen=True)
class Motion:
    """Poses over time.

    Attributes:
        path: the file.
        form: whose form it is, in words.
        betas: shape coefficients, `[1, B]` or `[N, B]`; None where the file has none that SMPL could use.
        global_orient: `[N, 3]`, radians.
        body_pose: `[N, 69]`, radians.
        transl: `[N, 3]`, metres.
        fps: frames a second; None where the file does not say.
        up: the axis that is up as stored, as `y` or `-y`: towards which the people's heads point on average, else
            the one that the form is known for; None where neither says.
        gender: as the file has it; None where it has none.
        left_out: what the file holds and SMPL has no place for, in words; empty where there is nothing.
    """

    path: Path
    form: str
    betas: Array | None
    global_orient: Array
    body_pose: Array
    transl: Array
    fps: float | None = None
    up: str | None = None
    gender: str | None = None
    left_out: str = ""

    def __len__(self) -> int:
        """Returns the number of frames."""
        return len(self.global_orient)


@dataclass(frozen=True)
class _Raw:
    form: str
    arrays: dict[str, Any]
    betas: Any = None
    fps: float | None = None
    usual_up: str | None = None
    left_out: str = ""


def read_motion(path: Path | str) -> Motion:
    """Returns the poses of a file in any of the forms above, all numbers checked.

    Raises:
        DataError: missing, damaged, of none of these forms, or NaN or infinite; names key and row.
    """
    motion = load_motion(path)
    for key in WIDTHS:
        bad = np.flatnonzero(~np.isfinite(getattr(motion, key)).all(axis=1))
        if len(bad):
            raise DataError(
                f"{path}, row {bad[0]}, {key} holds NaN or infinite values ({len(bad)} rows in all)."
            )
    return motion


def load_motion(path: Path | str) -> Motion:
    """Returns the same with the numbers of the rows unchecked, for readers that may not need all of them.

    Raises:
        DataError: missing, damaged, or of none of these forms.
    """
    path = Path(path)
    raw = _aist(load_pickle(path), str(path)) if path.suffix.lower() == ".pkl" else _npz(path)
    rows = len(raw.arrays["global_orient"]) if np.ndim(raw.arrays["global_orient"]) else 0
    arrays = {key: _rows(raw.arrays[key], rows, f"{path}, {key}", width) for key, width in WIDTHS.items()}
    if not rows:
        raise DataError(f"{path}: holds no frame.")
    return Motion(
        path,
        raw.form,
        None if raw.betas is None else _shapes(raw.betas, rows, f"{path}, betas"),
        **arrays,
        fps=raw.fps,
        up=measured_up(arrays["global_orient"]) or raw.usual_up,
        gender=None if path.suffix.lower() == ".pkl" else _gender(path),
        left_out=raw.left_out,
    )


def measured_up(global_orient: Array) -> str | None:
    """Returns the axis towards which a body's head points on average, as `z` or `-y`; None where none is clear.

    Args:
        global_orient: turns of the pelvis, `[N, 3]`, radians; rows that are not finite are passed over. A body at
            rest stands along +y.
    """
    finite = global_orient[np.isfinite(global_orient).all(axis=1)]
    if not len(finite):
        return None
    angle = np.linalg.norm(finite, axis=1, keepdims=True)
    axis = finite / np.maximum(angle, np.finfo(np.float64).tiny)
    upright = np.array([0.0, 1.0, 0.0])
    turned = upright * np.cos(angle) + np.cross(axis, upright) * np.sin(angle)
    turned += axis * axis[:, 1:2] * (1 - np.cos(angle))
    mean = turned.mean(axis=0)
    largest = int(np.abs(mean).argmax())
    if abs(mean[largest]) < _CLEAR:
        return None
    return ("-" if mean[largest] < 0 else "") + "xyz"[largest]


def _npz(path: Path) -> _Raw:
    content, where = load_npz(path, _KEYS), str(path)
    for key, form in (("thetas", _thetas), ("global_orient", _smplx), ("poses", _poses)):
        if key in content:
            return form(content, where)
    return _smplx(content, where)


def _thetas(content: Mapping[str, Any], where: str) -> _Raw:
    thetas = _matrix(content["thetas"], (SMPL_NUMBERS,), f"{where}, thetas")
    arrays = {
        "global_orient": thetas[:, :3],
        "body_pose": thetas[:, 3:],
        "transl": need(content, "transl", where),
    }
    return _Raw(THETAS, arrays, content.get("betas"))


def _smplx(content: Mapping[str, Any], where: str) -> _Raw:
    return _Raw("smplx's names", {key: need(content, key, where) for key in WIDTHS}, content.get("betas"))


def _poses(content: Mapping[str, Any], where: str) -> _Raw:
    poses = _matrix(content["poses"], (SMPL_NUMBERS, SMPLH_NUMBERS, SMPLX_NUMBERS), f"{where}, poses")
    rate = next((key for key in _RATES if key in content), None)
    width, fps, left_out = poses.shape[1], None, ""
    if rate is not None:
        fps = float(checks.numbers(content[rate], 1, f"{where}, {rate}")[0])
        if fps <= 0:
            raise DataError(f"{where}, {rate} is {fps:g}; it must be positive frames a second.")
    body, betas = poses[:, 3:], content.get("betas")
    if width != SMPL_NUMBERS:
        body = np.concatenate([poses[:, 3:_SHARED], np.zeros((len(poses), SMPL_NUMBERS - _SHARED))], axis=1)
        left_out = "hands"
    arrays = {
        "global_orient": poses[:, :3],
        "body_pose": body,
        "transl": need(content, "trans" if "trans" in content else "transl", where),
    }
    if width == SMPLX_NUMBERS or str(content.get("surface_model_type", "")) == "smplx":
        left_out = "hands, face, and betas, which are SMPL-X's and mean nothing to SMPL"
        return _Raw("AMASS, SMPL-X", arrays, None, fps, "z", left_out)
    if width == SMPLH_NUMBERS:
        return _Raw("AMASS, SMPL-H", arrays, betas, fps, "z", left_out)
    return _Raw("poses and trans, as InstantAvatar's dances", arrays, betas, fps, None, left_out)


def _aist(content: Any, where: str) -> _Raw:
    if not isinstance(content, Mapping):
        raise DataError(f"{where}: holds a {type(content).__name__}, not a table with smpl_poses.")
    poses = need(content, "smpl_poses", where)
    if isinstance(poses, np.ndarray) and poses.ndim == 3:  # as its loader's comments have it
        poses = poses.reshape(len(poses), -1)
    poses = _matrix(poses, (SMPL_NUMBERS,), f"{where}, smpl_poses")
    scale = float(checks.numbers(need(content, "smpl_scaling", where), 1, f"{where}, smpl_scaling")[0])
    if scale <= 0:
        raise DataError(f"{where}, smpl_scaling is {scale:g}; it must be positive.")
    trans = _rows(need(content, "smpl_trans", where), len(poses), f"{where}, smpl_trans", WIDTHS["transl"])
    arrays = {"global_orient": poses[:, :3], "body_pose": poses[:, 3:], "transl": trans / scale}
    return _Raw("AIST++", arrays, None, _AIST_RATE, "y")


def _matrix(value: Any, widths: tuple[int, ...], where: str) -> Array:
    shape = np.shape(value) if isinstance(value, np.ndarray) else ()
    if len(shape) != 2 or shape[1] not in widths or value.dtype.kind not in "fiu":
        expected = " or ".join(f"(N, {width})" for width in widths)
        raise DataError(f"{where} has shape {shape}, expected {expected}.")
    return np.asarray(value, dtype=np.float64)


def _rows(value: Any, rows: int, where: str, width: int) -> Array:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise DataError(f"{where} holds no numbers.")
    if value.shape != (rows, width):
        raise DataError(f"{where} has shape {value.shape}, expected ({rows}, {width}): one row a frame.")
    return np.asarray(value, dtype=np.float64)


def _shapes(value: Any, rows: int, where: str) -> Array:
    betas = value[None] if np.ndim(value) == 1 else value
    if np.ndim(betas) != 2 or len(betas) not in (1, rows) or betas.dtype.kind not in "fiu":
        raise DataError(f"{where} has shape {np.shape(value)}, expected (1, 10): one person, one shape.")
    return np.asarray(betas, dtype=np.float64)


def _gender(path: Path) -> str | None:
    """Returns the gender, which some files keep as a Python object and others as bytes; nothing depends on it."""
    try:
        value = load_npz(path, ("gender",)).get("gender")
    except DataError:
        return None
    if value is None or value.dtype.kind not in "US" or value.size != 1:
        return None
    word = value.reshape(-1)[0]
    return word.decode("latin1") if isinstance(word, bytes) else str(word)
