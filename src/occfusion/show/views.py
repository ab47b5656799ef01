"""Files of cameras: those of a run, a user's own, and `transforms.json` as nerfstudio has it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from occfusion.errors import DataError
from occfusion.files.atomic import write_json
from occfusion.files.jsonfile import parse_json
from occfusion.types import Camera

TRAIN, HELD_OUT = "train", "held_out"
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
MOST_PIXELS = 8192
"""Of a side of a picture."""
_RIGID = 1e-3
"""How far a rotation may be from orthonormal: files have few digits."""


@dataclass(frozen=True)
class View:
    """A camera at a moment.

    Attributes:
        camera: in the world of the sequence.
        frame: number of the frame in the sequence; None: of no moment.
        camera_index: which camera of the data set; None: of none.
        name: what captions call it.
    """

    camera: Camera
    frame: int | None = None
    camera_index: int | None = None
    name: str = ""


def write_views(path: Path, groups: Mapping[str, Iterable[View]]) -> None:
    """Writes views by group, `{"train": [...], "held_out": [...]}`; one list is named `cameras`."""
    write_json(path, {name: [_record(view) for view in views] for name, views in groups.items()})


def _record(view: View) -> dict[str, Any]:
    camera = view.camera
    return {
        "name": view.name, "frame": view.frame, "camera": view.camera_index,
        "viewmat": camera.viewmat.double().tolist(), "K": camera.K.double().tolist(),
        "width": camera.width, "height": camera.height,
    }  # fmt: skip


def read_views(path: Path, group: str = "cameras") -> list[View]:
    """Returns the views of a group of a `.json` file; OpenCV axes, metres, pixel centres at +0.5.

    Of nerfstudio's `transforms.json` the frames are the views: camera to world in OpenGL's axes, and a focal length.

    Raises:
        DataError: missing, damaged, without that group, or a camera that cannot be one; names the row.
    """
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise DataError(f"{path}: not readable JSON ({error})") from error
    if isinstance(content, dict) and "frames" in content and group == "cameras":
        rows, read = content["frames"], lambda row: _nerfstudio(row, content)
    else:
        rows, read = content.get(group) if isinstance(content, dict) else None, _view
    if not isinstance(rows, list) or not rows:
        raise DataError(
            f'{path}: holds no cameras; give {{"{group}": [{{"viewmat": 4 x 4, "K": 3 x 3, "width": W, "height": H}}, '
            "...]}, world to camera, x right, y down, z forward, or nerfstudio's transforms.json"
        )
    found = []
    for number, row in enumerate(rows):
        try:
            found.append(_checked(read(row)))
        except (ArithmeticError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise DataError(f"{path}, {group}[{number}]: no camera ({error!r})") from error
    return found


def _view(row: Mapping[str, Any]) -> View:
    camera = Camera(_matrix(row["viewmat"], 4), _matrix(row["K"], 3), int(row["width"]), int(row["height"]))
    frame, index = (None if row.get(key) is None else int(row[key]) for key in ("frame", "camera"))
    return View(camera, frame, index, str(row.get("name", "")))


def _nerfstudio(row: Mapping[str, Any], whole: Mapping[str, Any]) -> View:
    said = {**whole, **row}
    width, height = int(said["w"]), int(said["h"])
    if "fl_x" in said:
        fx, fy = float(said["fl_x"]), float(said.get("fl_y", said["fl_x"]))
    else:
        fx = fy = 0.5 * width / math.tan(0.5 * float(said["camera_angle_x"]))
    cx, cy = float(said.get("cx", width / 2)), float(said.get("cy", height / 2))
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    to_world = np.asarray(said["transform_matrix"], dtype=np.float64) @ _OPENGL
    return View(Camera(torch.from_numpy(np.linalg.inv(to_world)).float(), K, width, height))


def _matrix(value: Any, size: int) -> torch.Tensor:
    matrix = torch.tensor(value, dtype=torch.float32)
    if matrix.shape != (size, size):
        raise ValueError(f"shape {list(matrix.shape)}, expected [{size}, {size}]")
    return matrix


def _checked(view: View) -> View:
    viewmat, K = view.camera.viewmat, view.camera.K
    if not bool(viewmat.isfinite().all() and K.isfinite().all()):
        raise ValueError("NaN or infinite numbers")
    rotation = viewmat[:3, :3].double()
    off = float((rotation @ rotation.T - torch.eye(3)).abs().max())
    if off > _RIGID or float(torch.linalg.det(rotation)) < 0:
        raise ValueError(f"viewmat is not rigid: R R^t differs from the identity by {off:.2g}, or it mirrors")
    if not (float(K[0, 0]) > 0 and float(K[1, 1]) > 0):
        raise ValueError("K has no positive focal lengths")
    if not all(1 <= side <= MOST_PIXELS for side in (view.camera.width, view.camera.height)):
        raise ValueError(f"width and height must be from 1 to {MOST_PIXELS} pixels")
    return view
