"""Held-out cameras as OccNeRF's preparation writes them: `377_eval` beside `377`.

All cameras share one `cameras.pkl` and one `mesh_infos.pkl`, in the form of `humannerf_layout`, and one folder of
pictures; names say which is which: `camera_02_frame_000030` is camera 02, counted from 1, at the moment that
`377` calls `frame_000030`. Every 30th moment is there.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from occfusion.data import checks
from occfusion.data.fixed_camera import FixedCamera
from occfusion.data.layouts import HELD_OUT, held_out_of
from occfusion.data.lens import OPENCV_CENTRE
from occfusion.data.listing import natural, pngs_in
from occfusion.data.scene import Calibration, PictureFiles
from occfusion.data.tables import entry, load_table, need
from occfusion.errors import DataError

_NAME = re.compile(r"camera_(\d{1,12})_frame_(\d{1,12})\Z")
_FRAME = re.compile(r"frame_(\d{1,12})\Z")

SAME_BODY = 1e-5
"""Largest difference of `Rh`, `Th` and `poses` (radians, metres) between two tables made of the same files."""


class HeldOut:
    """The cameras of a `*_eval` folder, at the frames of the training folder.

    Attributes:
        folder: where they lie.
        cameras: their names.
        calibrations: one a camera.
        evidence: the files that determine them.
    """

    def __init__(self, folder: Path, frames: Sequence[str], meshes: Mapping[str, Any]) -> None:
        """Reads the tables and lists the pictures.

        Args:
            folder: the `*_eval` folder.
            frames: names of the training frames.
            meshes: the bodies of the training folder, by name.

        Raises:
            DataError: a file or row is missing or cannot be, a camera moves, or the bodies are others.
        """
        self.folder, self.evidence = folder, (folder / "cameras.pkl", folder / "mesh_infos.pkl")
        rows = load_table(self.evidence[0])
        odd = next((name for name in rows if _NAME.match(name) is None), None)
        if odd is not None:
            raise DataError(
                f"{self.evidence[0]}: {odd!r} is no name of a held-out view, as 'camera_02_frame_000000'. If "
                f"{folder.name} is a sequence of its own, give the folder a name that does not end in _eval."
            )
        numbers = {int(m[1]): frame for frame, name in enumerate(frames) if (m := _FRAME.match(name))}
        self._views = {}
        for name in sorted(rows, key=natural):
            camera, moment = _parts(name)
            if moment in numbers:
                self._views[numbers[moment], camera] = name
        self.dropped = len(rows) - len(self._views)
        if not self._views:
            raise DataError(
                f"{self.evidence[0]}: none of its {len(rows)} views is at a frame of the training folder."
            )
        found = sorted({camera for _, camera in self._views})
        self._numbers = dict(enumerate(found))
        self.cameras = tuple(f"camera_{camera:02d}" for camera in found)
        self.calibrations = [self._camera(rows, camera) for camera in found]
        self._require_same_bodies(frames, meshes)
        self._images = pngs_in(folder / "images")
        self._masks = pngs_in(folder / "masks")

    @classmethod
    def beside(
        cls, folder: Path, frames: Sequence[str], meshes: Mapping[str, Any], *, still: bool
    ) -> HeldOut | None:
        """Returns the held-out cameras that lie beside a training folder; None where there are none.

        Args:
            folder: the training folder.
            frames: names of its frames.
            meshes: its bodies, by name.
            still: its camera stands still, so that the frames share one world.
        """
        path = folder.with_name(f"{folder.name}{HELD_OUT}")
        if not still or not all((path / name).is_file() for name in ("cameras.pkl", "mesh_infos.pkl")):
            return None
        return cls(path, frames, meshes)

    def shows(self, frame: int, camera: int) -> bool:
        """Whether a camera, by position here, has a picture at a training frame."""
        return (frame, self._numbers[camera]) in self._views

    def files(self, frame: int, camera: int) -> PictureFiles:
        """Returns the paths of one picture and its mask; they need not exist."""
        name = self._views.get((frame, self._numbers[camera]), f"{self.cameras[camera]} at frame {frame}")
        image = self._images.get(name, self.folder / "images" / f"{name}.png")
        mask = self._masks.get(name, self.folder / "masks" / f"{name}.png")
        return PictureFiles(name, image, (mask,), None, None)

    def summary(self) -> str:
        """Returns what there is, in words."""
        frames = len({frame for frame, _ in self._views})
        dropped = (
            f", {self.dropped} views at moments that the training folder has not" if self.dropped else ""
        )
        return f"held out: {len(self.cameras)} cameras of {self.folder.name}/ at {frames} moments{dropped}"

    def _camera(self, rows: Mapping[str, Any], camera: int) -> Calibration:
        names = [name for (_, number), name in self._views.items() if number == camera]
        chosen = [entry(rows, name, self.evidence[0]) for name in names]
        where = [f"{self.evidence[0]}, {name}" for name in names]
        found = FixedCamera(
            f"camera_{camera:02d}",
            [need(row, "intrinsics", at) for row, at in zip(chosen, where, strict=True)],
            [need(row, "extrinsics", at) for row, at in zip(chosen, where, strict=True)],
            [row.get("distortions", np.zeros(5)) for row in chosen],
            where,
            OPENCV_CENTRE,
        )
        if found.moves:
            raise DataError(
                f"{where[0]}: the camera moves from frame to frame; a held-out camera must stand still."
            )
        return found.calibration

    def _require_same_bodies(self, frames: Sequence[str], meshes: Mapping[str, Any]) -> None:
        rows = load_table(self.evidence[1])
        for (frame, _), name in self._views.items():
            where = f"{self.evidence[1]}, {name}"
            if name not in rows:
                raise DataError(
                    f"{self.evidence[1]}: has no {name!r}, which cameras.pkl has; prepare it again."
                )
            mine, other = entry(rows, name, self.evidence[1]), meshes[frames[frame]]
            for key in ("Rh", "Th", "poses"):
                value = checks.numbers(
                    need(mine, key, where), checks.count_of(need(other, key, where)), f"{where}, {key}"
                )
                apart = np.abs(value - np.asarray(other[key], dtype=np.float64).reshape(-1)).max()
                if apart > SAME_BODY:
                    raise DataError(
                        f"{where}: {key} differs by {apart:.3g} from that of {frames[frame]} in the training folder: "
                        f"the two are not of one sequence, or of different fits. Move {self.folder.name} away, or "
                        "prepare it again."
                    )


def refuse_held_out_alone(folder: Path, rows: Mapping[str, Any]) -> None:
    """Raises DataError for a folder of several held-out cameras, which cannot be trained on; says what to open."""
    found = {match[1] for name in rows if (match := _NAME.match(name))}
    if len(found) < 2:
        return
    beside = held_out_of(folder)
    cure = "Open the folder of the training camera: this one is read with it if it is named like it, with _eval added."
    if beside is not None:
        there = "" if beside.is_dir() else ", which is missing: prepare it too"
        cure = f"Open {beside.name}{there}: these cameras are read with it."
    raise DataError(
        f"{folder}: holds the held-out views of {len(found)} cameras in one table, as OccNeRF's evaluation has them "
        f"({next(iter(rows))!r}), and no training camera. {cure}"
    )


def _parts(name: str) -> tuple[int, int]:
    match = _NAME.match(name)
    assert match is not None  # all names were looked at
    return int(match[1]), int(match[2])
