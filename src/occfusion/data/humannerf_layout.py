"""The files that HumanNeRF's and OccNeRF's preparation writes: one camera, one folder a sequence.

| file | content |
|---|---|
| `images/frame_000000.png`, `masks/frame_000000.png` | pictures; masks 0 and 255, 1 or 3 channels |
| `cameras.pkl` | `{frame: {intrinsics, extrinsics (world to camera, metres), distortions}}` |
| `mesh_infos.pkl` | `{frame: {Rh, Th, poses, betas, joints, tpose_joints}}` |
| `canonical_joints.pkl` | `{joints, avg_betas}`; optional, `avg_betas` stands in for missing `betas` |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from occfusion.data import checks
from occfusion.data.convention import easymocap_to_smplx, turned_about
from occfusion.data.fixed_camera import FixedCamera
from occfusion.data.lens import OPENCV_CENTRE
from occfusion.data.listing import natural, partners, pictures_in, require_same
from occfusion.data.scene import Array, BodyParameters, Calibration, PictureFiles, Scene
from occfusion.errors import DataError
from occfusion.files.unpickle import load_pickle

_KEYS = {"poses": 72, "Rh": 3, "Th": 3}


class HumanNerfScene(Scene):
    """A sequence in HumanNeRF's form."""

    def __init__(self, folder: Path, pelvis: Callable[[Array], Array], masks: str = "masks") -> None:
        """Reads the two tables and lists the pictures.

        Args:
            folder: the sequence's folder.
            pelvis: gives the pelvis at rest, `[3]` in metres, for shape coefficients `[B]`.
            masks: mask folder.

        Raises:
            DataError: a file, key or frame is missing, or what they hold cannot be.
        """
        self.name, self.root, self._pelvis = folder.name, folder, pelvis
        self._meshes_file = folder / "mesh_infos.pkl"
        cameras = table(load_pickle(folder / "cameras.pkl"), folder / "cameras.pkl")
        self._meshes = table(load_pickle(self._meshes_file), self._meshes_file)
        require_same(cameras, str(folder / "cameras.pkl"), self._meshes, str(self._meshes_file))
        images = pictures_in(folder / "images")
        require_same(cameras, str(folder / "cameras.pkl"), images, str(folder / "images"))
        self._names = sorted(cameras, key=natural)
        self._pictures = [images[name] for name in self._names]
        self._masks = partners(self._names, pictures_in(folder / masks), folder / masks)
        self.num_frames, self.cameras = len(self._names), ("camera",)
        rows = [entry(cameras, name, folder / "cameras.pkl") for name in self._names]
        where = [f"{folder / 'cameras.pkl'}, {name}" for name in self._names]
        self._camera = FixedCamera(
            "camera",
            [need(row, "intrinsics", at) for row, at in zip(rows, where, strict=True)],
            [need(row, "extrinsics", at) for row, at in zip(rows, where, strict=True)],
            [row.get("distortions", np.zeros(5)) for row in rows],
            where,
            OPENCV_CENTRE,
        )

    def calibration(self, camera: int) -> Calibration:
        """Returns the one camera there is."""
        return self._camera.calibration

    def parameters(self, frame: int) -> BodyParameters:
        """Returns the body of a frame in the convention of smplx."""
        name = self._names[frame]
        where = f"{self._meshes_file}, {name}"
        row = entry(self._meshes, name, self._meshes_file)
        values = {
            key: checks.numbers(need(row, key, where), size, f"{where}, {key}") for key, size in _KEYS.items()
        }
        given = row["betas"] if "betas" in row else self._mean_betas(where)
        betas = checks.shape_numbers(given, f"{where}, betas")
        pelvis, poses = self._pelvis(betas), values["poses"]
        if "tpose_joints" in row and not poses[:3].any():
            rest = checks.numbers(row["tpose_joints"], (24, 3), f"{where}, tpose_joints")
            orient, transl = turned_about(values["Rh"], values["Th"], rest[0], pelvis)
        else:
            orient, transl = easymocap_to_smplx(values["Rh"], values["Th"], poses[:3], pelvis)
        return self._camera.carry(frame, BodyParameters(betas, orient, poses[3:], transl), pelvis)

    def files(self, frame: int, camera: int) -> PictureFiles:
        """Returns the paths of one picture and its mask."""
        return PictureFiles(self._names[frame], self._pictures[frame], (self._masks[frame],), None, None)

    def evidence(self, frame: int) -> tuple[Path, ...]:
        """Returns the two tables."""
        return self.root / "cameras.pkl", self._meshes_file

    def _mean_betas(self, where: str) -> Any:
        path = self.root / "canonical_joints.pkl"
        if not path.is_file():
            raise DataError(f"{where} has no betas, and there is no {path.name} with avg_betas.")
        return need(table(load_pickle(path), path), "avg_betas", str(path))


def table(content: Any, path: Path) -> Mapping[str, Any]:
    """Returns the content of a file that must hold a table of frames or values.

    Raises:
        DataError: it holds something else, nothing, or keys that are not text.
    """
    if not isinstance(content, Mapping) or not content:
        raise DataError(f"{path}: holds a {type(content).__name__}, not a table of frames.")
    if not all(isinstance(key, str) for key in content):
        raise DataError(f"{path}: the frames must be named by text, as 'frame_000000'.")
    return content


def entry(rows: Mapping[str, Any], name: str, path: Path) -> Mapping[str, Any]:
    """Returns the row of a frame, which must be a table itself."""
    row = rows[name]
    if not isinstance(row, Mapping):
        raise DataError(f"{path}, {name}: holds a {type(row).__name__}, not a table.")
    return row


def need(row: Mapping[str, Any], key: str, where: str) -> Any:
    """Returns the value of a key.

    Raises:
        DataError: it is missing; says what is there.
    """
    if key not in row:
        raise DataError(f"{where}: key {key!r} is missing; it has {', '.join(map(str, row))[:200]}.")
    return row[key]
