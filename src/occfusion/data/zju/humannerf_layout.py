"""The files that HumanNeRF's and OccNeRF's preparation writes: one camera, one folder a sequence.

| file | content |
|---|---|
| `images/frame_000000.png`, `masks/frame_000000.png` | pictures; masks 0 and 255, 1 or 3 channels |
| `cameras.pkl` | `{frame: {intrinsics, extrinsics (world to camera, metres)[, distortions]}}` |
| `mesh_infos.pkl` | `{frame: {Rh, Th, poses, joints, tpose_joints[, betas, dapose_joints]}}` |
| `canonical_joints.pkl` | `{joints[, avg_betas]}`; `avg_betas` stands in where neither `betas` nor joints are |
| `metadata.json` | what other footage was prepared from; not read |

HumanNeRF writes no `betas`: they follow from `tpose_joints` (`rest_joints`). A body is placed by
`x = R(Rh) (R(poses[:3]) (m - J0) + tpose_joints[0]) + Th`: for ZJU-MoCap the rest pose is the body's own, for other
footage its pelvis is at 0 and `Th` is the pelvis. There K and the extrinsics may be given anew for each frame, as
follows from a weak-perspective camera; the pictures say which frames there are, tables and masks may have more.
Beside a folder `377` OccNeRF's held-out cameras lie in `377_eval` (`held_out`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from occfusion.data.body_convention import easymocap_to_smplx, turned_about
from occfusion.data.cameras import FixedCamera
from occfusion.data.checking import checks
from occfusion.data.folder_contents import (
    entry,
    like,
    load_table,
    need,
    partners,
    pngs_in,
    require_same,
    strays,
)
from occfusion.data.layouts import HELD_OUT, held_out_of
from occfusion.data.posing import Poser, joints_remark, shape_from_joints
from occfusion.data.scene import Array, BodyParameters, Calibration, PictureFiles, Scene, Taken
from occfusion.errors import DataError
from occfusion.files.naming import natural

_NAME = re.compile(r"camera_(\d{1,12})_frame_(\d{1,12})\Z")
_FRAME = re.compile(r"frame_(\d{1,12})\Z")
_CAMERA_KEYS = ("intrinsics", "extrinsics"), "distortions"

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
            if (match := _NAME.match(name)) and (moment := int(match[2])) in numbers:
                self._views[numbers[moment], int(match[1])] = name
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
        found = FixedCamera.of_rows(f"camera_{camera:02d}", chosen, where, *_CAMERA_KEYS)
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


CAMERAS, MESHES, JOINTS = "cameras.pkl", "mesh_infos.pkl", "canonical_joints.pkl"

_KEYS = {"poses": 72, "Rh": 3, "Th": 3}


class HumanNerfScene(Scene):
    """A sequence in HumanNeRF's form, with OccNeRF's held-out cameras where they lie beside it."""

    def __init__(self, folder: Path, body: Poser, masks: str = "masks") -> None:
        """Reads the tables and lists the pictures.

        Args:
            folder: the sequence's folder.
            body: the body that the tables were made with.
            masks: mask folder.

        Raises:
            DataError: a file, key or frame is missing, or what they hold cannot be.
        """
        self.name, self.root, self._body = folder.name, folder, body
        self._cameras_file, self._meshes_file = folder / CAMERAS, folder / MESHES
        cameras, self._meshes = load_table(self._cameras_file), load_table(self._meshes_file)
        refuse_held_out_alone(folder, cameras)
        require_same(cameras, str(self._cameras_file), self._meshes, str(self._meshes_file))
        images = pngs_in(folder / "images")
        self._names = sorted(set(images) & set(cameras), key=natural)
        if not self._names:
            raise DataError(
                f"{folder / 'images'}: none of its {len(images)} pictures, the first {next(iter(images))!r}, is named "
                f"in {CAMERAS}, which has {len(cameras)} frames, the first {next(iter(cameras))!r}. They are of "
                "different sequences, or one of them was renamed."
            )
        unknown = set(like(images, cameras)) - set(cameras)
        require_same(self._names, str(self._cameras_file), {*self._names, *unknown}, str(folder / "images"))
        self._pictures = [images[name] for name in self._names]
        found = pngs_in(folder / masks)
        self._masks = partners(self._names, found, folder / masks, more=True)
        self.num_frames = len(self._names)
        where = [f"{self._cameras_file}, {name}" for name in self._names]
        rows = [entry(cameras, name, self._cameras_file) for name in self._names]
        self._camera = FixedCamera.of_rows("camera", rows, where, *_CAMERA_KEYS, may_zoom=True)
        self._held_out = HeldOut.beside(folder, self._names, self._meshes, still=not self._camera.moves)
        self.cameras = ("camera", *(self._held_out.cameras if self._held_out else ()))
        self.zooms = self._camera.zooms
        self.taken = self._taken(len(images), len(cameras), masks)

    def calibration(self, camera: int) -> Calibration:
        """Returns the camera trained on, as it was at the first frame, or one that is held out."""
        return (
            self._held_out.calibrations[camera - 1] if self._held_out and camera else self._camera.calibration
        )

    def view(self, frame: int, camera: int) -> Calibration:
        """Returns a camera with the K of a frame."""
        return self.calibration(camera) if camera else self._camera.at(frame)

    def shows(self, frame: int, camera: int) -> bool:
        """Whether there is a picture: held-out cameras have some of the frames."""
        return camera == 0 or (self._held_out is not None and self._held_out.shows(frame, camera - 1))

    def parameters(self, frame: int) -> BodyParameters:
        """Returns the body of a frame in the convention of smplx.

        Raises:
            DataError: numbers are missing or cannot be, or the rest joints are of another body.
        """
        row, rest, where = self._row(self._names[frame])
        values = {
            key: checks.numbers(need(row, key, where), size, f"{where}, {key}") for key, size in _KEYS.items()
        }
        betas = self._betas(row, rest, where)
        self._joints_remark(rest, betas, where)
        pelvis, poses = self._body.pelvis(betas), values["poses"]
        if rest is None:
            orient, transl = easymocap_to_smplx(values["Rh"], values["Th"], poses[:3], pelvis)
        else:
            orient, transl = turned_about(values["Rh"], values["Th"], poses[:3], rest[0], pelvis)
        return self._camera.carry(frame, BodyParameters(betas, orient, poses[3:], transl), pelvis)

    def body_warnings(self, pose: Callable[[BodyParameters], tuple[Array, Array]]) -> list[str]:
        """Returns a sentence where `tpose_joints` of a frame are near the body's joints at rest, but not the same.

        Raises:
            DataError: they are another body's.
        """
        for name in self._names:
            row, rest, where = self._row(name)
            if remark := self._joints_remark(rest, self._betas(row, rest, where), where):
                return [remark]
        return []

    def _row(self, name: str) -> tuple[Mapping[str, Any], Array | None, str]:
        """Returns the body of a frame, its joints at rest where it has them, and what messages call it."""
        row, where = entry(self._meshes, name, self._meshes_file), f"{self._meshes_file}, {name}"
        if "tpose_joints" not in row:
            return row, None, where
        return row, checks.numbers(row["tpose_joints"], (24, 3), f"{where}, tpose_joints"), where

    def _joints_remark(self, rest: Array | None, betas: Array, where: str) -> str:
        """Returns what `joints_remark` says, of a body that does not stand in for the one of the tables."""
        if rest is None or self._body.stands_in:
            return ""
        return joints_remark(rest, self._body.joints(betas), f"{where}, tpose_joints")

    def _betas(self, row: Mapping[str, Any], rest: Array | None, where: str) -> Array:
        if "betas" in row:
            return checks.shape_numbers(row["betas"], f"{where}, betas")
        if rest is not None:
            return shape_from_joints(rest, self._body)
        path = self.root / JOINTS
        if not path.is_file():
            raise DataError(
                f"{where} has neither betas nor tpose_joints, and there is no {JOINTS} with avg_betas."
            )
        return checks.shape_numbers(need(load_table(path), "avg_betas", str(path)), f"{path}, avg_betas")

    def files(self, frame: int, camera: int) -> PictureFiles:
        """Returns the paths of one picture and its mask."""
        if self._held_out and camera:
            return self._held_out.files(frame, camera - 1)
        return PictureFiles(self._names[frame], self._pictures[frame], (self._masks[frame],), None, None)

    def evidence(self, frame: int) -> tuple[Path, ...]:
        """Returns the tables."""
        return self._cameras_file, self._meshes_file, *(self._held_out.evidence if self._held_out else ())

    def _taken(self, pictures: int, rows: int, masks: str) -> Taken:
        row, rest, _ = self._row(self._names[0])
        form = "turned about the origin, as in ZJU-MoCap"
        if rest is not None and not rest[0].any():
            form = "turned about the pelvis, as in other footage"
        counts = [f"images/, {self.num_frames} of {pictures}"]
        counts += [f"{pictures - self.num_frames} without a row in {CAMERAS}"] * (pictures > self.num_frames)
        counts += [f"{rows - self.num_frames} rows of {CAMERAS} without a picture"] * (rows > self.num_frames)
        counts += [self._held_out.summary()] if self._held_out else []
        shape = "betas of mesh_infos.pkl" if "betas" in row else f"avg_betas of {JOINTS}"
        if "betas" not in row and rest is not None:
            shape = f"from tpose_joints of {MESHES} by least squares: it has no betas"
        camera = f"{CAMERAS}, {'moves: carried over to the person' if self._camera.moves else 'stands still'}"
        camera += "; K changes: each frame has its own" if self.zooms else ""
        return Taken(
            layout="humannerf (HumanNeRF's and OccNeRF's preparation)",
            pictures="; ".join(counts),
            body=f"{MESHES}: Rh, Th, poses, {form}",
            shape=shape,
            masks=f"{masks}/: 255 is the person",
            cameras=camera,
            centres="0 (OpenCV)",
            others=self._others(masks),
        )

    def _others(self, masks: str) -> str:
        """Returns what lies in the folder and is not read."""
        eval_folder = self.root.with_name(f"{self.name}{HELD_OUT}")
        read = {self._cameras_file, self._meshes_file, self.root / "images", self.root / masks}
        groups = [strays(self.root, read)]
        for folder, taken in (("images", self._pictures), (masks, self._masks)):
            groups.append([f"{folder}/{name}" for name in strays(self.root / folder, taken)])
        if self._held_out is None and eval_folder.is_dir():
            groups.append([f"../{eval_folder.name}"])
        listed = [f"{', '.join(group[:8])}{' ...' if len(group) > 8 else ''}" for group in groups if group]
        return f"not read: {', '.join(listed)}" if listed else ""
