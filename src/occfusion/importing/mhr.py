"""What SAM 3D Body sees, whose body is MHR and not SMPL: key points in the picture and in space, and its camera.

Its program writes no file: users keep the dict of a person, or the list of a picture's people, that
`process_one_image` returns (facebookresearch/sam-3d-body `sam_3d_body/sam_3d_body_estimator.py`). Our body is fitted
to the 70 key points of `sam_3d_body/metadata/mhr70.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.arrays import load_npy, load_npz
from occfusion.footage.camera import pinhole
from occfusion.footage.landmarks import COUNT, INDEX

Floats = NDArray[np.float64]

POINTS = 70
PLACES = {
    **dict(zip(("nose", "left_eye", "right_eye", "left_ear", "right_ear"), range(5), strict=True)),
    "left_shoulder": 5, "right_shoulder": 6, "left_elbow": 7, "right_elbow": 8, "left_hip": 9, "right_hip": 10,
    "left_knee": 11, "right_knee": 12, "left_ankle": 13, "right_ankle": 14, "left_foot_index": 15, "left_heel": 17,
    "right_foot_index": 18, "right_heel": 20, "right_index": 28, "right_pinky": 40, "right_wrist": 41,
    "left_index": 49, "left_pinky": 61, "left_wrist": 62,
}  # fmt: skip
"""Of our landmarks the place among the 70."""
_KEYS = ("pred_keypoints_2d", "pred_keypoints_3d", "pred_cam_t")


def files_of(path: Path) -> list[Path]:
    """Returns the dumps of a folder, or a file that is one; empty where there are none."""
    suffixes = (".npz", ".npy")
    if path.is_dir():
        return [file for file in path.iterdir() if file.suffix.lower() in suffixes]
    return [path] if path.suffix.lower() in suffixes else []


def is_mhr(path: Path) -> bool:
    """Returns whether a file or folder holds dumps of SAM 3D Body."""
    try:
        return any(people_of(file) for file in sorted(files_of(path))[:1])
    except DataError:
        return False


def people_of(file: Path) -> list[tuple[Floats, Floats, Floats]]:
    """Returns pixels `[70, 2]`, places relative to the middle of the hips and in the camera `[70, 3]`, of each person.

    Raises:
        DataError: damaged, or no dump of SAM 3D Body.
    """
    content: Any = load_npz(file, _KEYS) if file.suffix.lower() == ".npz" else load_npy(file)
    if isinstance(content, np.ndarray) and content.dtype == object:
        content = content.reshape(-1).tolist()
    people = [content] if isinstance(content, Mapping) else content
    out = []
    for k, person in enumerate(people if isinstance(people, list) else [None]):
        if not isinstance(person, Mapping) or any(key not in person for key in _KEYS):
            raise DataError(f"{file}, person {k}: has not {', '.join(_KEYS)} of SAM 3D Body.")
        try:
            flat = np.asarray(person[_KEYS[0]], dtype=np.float64).reshape(POINTS, 2)
            deep = np.asarray(person[_KEYS[1]], dtype=np.float64).reshape(POINTS, 3)
            there = deep + np.asarray(person[_KEYS[2]], dtype=np.float64).reshape(3)
        except (TypeError, ValueError) as error:
            raise DataError(f"{file}, person {k}: not {POINTS} key points ({error}).") from error
        if not (np.isfinite(flat).all() and np.isfinite(there).all()):
            raise DataError(f"{file}, person {k}: holds NaN or infinite values.")
        hips = deep[[PLACES["left_hip"], PLACES["right_hip"]]].mean(axis=0)
        out.append((flat, deep - hips, there))
    return out


def as_ours(flat: Floats, deep: Floats) -> tuple[Floats, Floats, Floats]:
    """Returns pixels, confidence and places of our 33 landmarks."""
    pixels, confidence, world = np.zeros((COUNT, 2)), np.zeros(COUNT), np.zeros((COUNT, 3))
    for name, place in PLACES.items():
        k = INDEX[name]
        pixels[k], confidence[k], world[k] = flat[place], 1.0, deep[place]
    return pixels, confidence, world


def camera_of(flat: Floats, there: Floats) -> Floats:
    """Returns the intrinsics by which places in the camera `[N, 3]` are at pixels `[N, 2]`, in least squares.

    The focal length is one, and not always in the dump; the principal point never is.
    """
    ray = there[:, :2] / there[:, 2:]
    zero, one = np.zeros(len(ray)), np.ones(len(ray))
    rows = np.concatenate([np.column_stack([ray[:, 0], one, zero]), np.column_stack([ray[:, 1], zero, one])])
    f, cx, cy = np.linalg.lstsq(rows, np.concatenate([flat[:, 0], flat[:, 1]]), rcond=None)[0]
    return pinhole(f, f, cx, cy)
