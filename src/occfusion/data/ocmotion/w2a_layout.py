"""OcMotion as Wild2Avatar cut it: `<sequence>_w2a/`, one camera, real occluders.

| file | content |
|---|---|
| `images/00256.png`, `masks/00256.png` | pictures; masks of the visible person, any channel, not 0 |
| `metadata.json` | `{picture without suffix: {poses, betas, trans, cam_intrinsics, cam_extrinsics}}` |
| `mesh_infos.pkl` | `{picture: {Rh, Th, poses, betas, joints, tpose_joints}}`, made from it; optional |

The convention is that of SMPL: the root's rotation is the first three of `poses`, and
`x = SMPL(poses, betas) + trans`. Pictures decide which frames there are; `metadata.json` may have rows of the whole
sequence. Other footage prepared for HumanNeRF has the same file without `trans`; its person then stands at the
origin.

The preparation's `mesh_infos.pkl` has the pelvis at 0 and the root's rotation as `Rh`, the same as in `poses`; its
joints at rest are compared with the body's. Its `cameras.pkl` has `trans` in the extrinsics, and so has
`all_cameras.pkl`, of the sequence's six cameras; neither is read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from occfusion.data.cameras import FixedCamera
from occfusion.data.checking import checks
from occfusion.data.folder_contents import (
    SUFFIXES,
    entry,
    load_table,
    need,
    partners,
    pictures_in,
    require_same,
    table,
)
from occfusion.data.ocmotion.ocmotion_joints import COMPARED_FRAMES, Posing
from occfusion.data.posing import joints_remark
from occfusion.data.sampling import evenly
from occfusion.data.scene import Array, BodyParameters, Calibration, PictureFiles, Scene, Taken
from occfusion.errors import DataError
from occfusion.files.jsonfile import load_json
from occfusion.files.naming import natural

METADATA = "metadata.json"
MESHES = "mesh_infos.pkl"

SAME_TURN = 1e-3
"""Radians between two records of one rotation: more is no rounding."""

NOT_READ = {
    "mesh_infos.pkl": "the same poses in HumanNeRF's form, of which only the joints at rest are compared",
    "cameras.pkl": "the same camera with `trans` in it",
    "canonical_joints.pkl": "joints of the mean shape",
    "all_cameras.pkl": "all cameras of the sequence: of those beyond the first the cut has no pictures",
    "all_mesh_infos.pkl": "the poses once a camera",
}
"""What the preparation writes beside what is read here."""


class W2aScene(Scene):
    """A sequence of Wild2Avatar's cut."""

    def __init__(
        self,
        folder: Path,
        pelvis: Callable[[Array], Array],
        masks: str = "masks",
        person: int | None = None,
    ) -> None:
        """Reads the table and lists the pictures.

        Args:
            folder: the sequence's folder.
            pelvis: gives the pelvis at rest, `[3]` in metres, for shape coefficients `[B]`.
            masks: mask folder.
            person: the value of the wanted person in masks that number several.

        Raises:
            DataError: a file, key or frame is missing, or what they hold cannot be.
        """
        self.name, self.root = folder.name, folder
        self._pelvis, self._person, self._file = pelvis, person, folder / METADATA
        rows = _by_picture(table(load_json(self._file), self._file), self._file)
        images = pictures_in(folder / "images")
        require_same(images, str(folder / "images"), rows.keys() & images.keys(), str(self._file))
        self._names = sorted(images, key=natural)
        self._rows = {name: entry(rows, name, self._file) for name in self._names}
        self._pictures = [images[name] for name in self._names]
        self._masks, spare_masks = _masks(self._names, folder / masks)
        self.num_frames, self.cameras = len(self._names), ("camera",)
        where = [self._where(frame) for frame in range(self.num_frames)]
        chosen = list(self._rows.values())
        self._has_trans = _all_or_none(chosen, "trans", where)
        self._camera = FixedCamera.of_rows("camera", chosen, where, ("cam_intrinsics", "cam_extrinsics"))
        meshes = folder / MESHES
        self._meshes: Mapping[str, Any] = load_table(meshes) if meshes.is_file() else {}
        place = (
            " + trans" if self._has_trans else "; there is no trans, so that the person stands at the origin"
        )
        values = "every value but 0 (of a JPEG with soft edges: from 128 on)"
        values = values if person is None else f"value {person}"
        moves = "moves, which is carried over to the person" if self._camera.moves else "stands still"
        self.taken = Taken(
            layout="OcMotion as Wild2Avatar cut it (w2a)",
            pictures=_pictures_in_words(self.num_frames, len(rows), spare_masks, masks),
            body=f"{METADATA}: SMPL(poses, betas){place}, the root's rotation in poses[:3]",
            shape=f"betas of {METADATA}, {_shapes_in_words(chosen)}",
            masks=f"{masks}/, {values}",
            cameras=f"{METADATA}: cam_intrinsics and cam_extrinsics; the camera {moves}",
            centres="0 (OpenCV)",
            others=_others(folder, masks),
        )

    def calibration(self, camera: int) -> Calibration:
        """Returns the one camera there is."""
        return self._camera.calibration

    def parameters(self, frame: int) -> BodyParameters:
        """Returns the body of a frame."""
        body = self._own_parameters(frame)
        return self._camera.carry(frame, body, self._pelvis(body.betas))

    def files(self, frame: int, camera: int) -> PictureFiles:
        """Returns the paths of one picture and its mask."""
        name, mask = self._names[frame], self._masks[frame]
        picture = self._pictures[frame]
        return PictureFiles(name, picture, (mask,), None, None, True, self._person, any_value=True)

    def evidence(self, frame: int) -> tuple[Path, ...]:
        """Returns the table."""
        return (self._file,)

    def body_warnings(self, pose: Posing) -> list[str]:
        """Returns what `mesh_infos.pkl` says against the body: its joints at rest and the root's rotation.

        Raises:
            DataError: its joints at rest are another body's.
        """
        path = self.root / MESHES
        remarks: list[str] = []
        known = [frame for frame, name in enumerate(self._names) if name in self._meshes]
        turned: list[str] = []
        for frame in evenly(known, COMPARED_FRAMES):
            name = self._names[frame]
            row, where, body = entry(self._meshes, name, path), f"{path}, {name}", self._own_parameters(frame)
            if "tpose_joints" in row:
                given = checks.numbers(row["tpose_joints"], (24, 3), f"{where}, tpose_joints")
                own = pose(BodyParameters(body.betas, np.zeros(3), np.zeros(69), np.zeros(3)))[1]
                remarks.append(joints_remark(given, own, f"{where}, tpose_joints"))
            if "Rh" in row:
                Rh = checks.numbers(row["Rh"], 3, f"{where}, Rh")
                turned += [name] if checks.turn_between(Rh, body.global_orient) > SAME_TURN else []
        warnings = [remark for remark in remarks if remark][:1]
        if turned:
            warnings.append(
                f"{path}: Rh is another rotation than poses[:3] of {METADATA} in {len(turned)} of the frames looked "
                f"at, first {turned[0]}. OccFusion trains on Rh; {METADATA} is used here. Make {MESHES} again from "
                "it, or remove it."
            )
        return warnings

    def _own_parameters(self, frame: int) -> BodyParameters:
        """Returns the body of a frame in the frame's own world."""
        row, where = self._rows[self._names[frame]], self._where(frame)
        poses = checks.numbers(need(row, "poses", where), 72, f"{where}, poses")
        betas = checks.shape_numbers(need(row, "betas", where), f"{where}, betas")
        transl = checks.numbers(row["trans"] if self._has_trans else np.zeros(3), 3, f"{where}, trans")
        return BodyParameters(betas, poses[:3], poses[3:], transl)

    def _where(self, frame: int) -> str:
        return f"{self._file}, {self._names[frame]}"


def _by_picture(rows: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Returns the rows by the picture's name; keys may be file names."""
    found: dict[str, Any] = {}
    for key, row in rows.items():
        name = Path(key).stem if Path(key).suffix.lower() in SUFFIXES else key
        if name in found:
            raise DataError(f"{path}: has two rows for the picture {name!r}; keep one of them.")
        found[name] = row
    return found


def _masks(names: list[str], folder: Path) -> tuple[tuple[Path, ...], int]:
    """Returns the mask of each picture, and how many others there are."""
    there = pictures_in(folder)
    own = {name: there[name] for name in names if name in there}
    whole = len(own) == len(names)
    return partners(names, own if whole else there, folder), len(there) - len(own) if whole else 0


def _all_or_none(rows: list[Mapping[str, Any]], key: str, where: list[str]) -> bool:
    """Returns whether the rows have a key.

    Raises:
        DataError: some have it and some have not.
    """
    lacking = [at for row, at in zip(rows, where, strict=True) if key not in row]
    if lacking and len(lacking) < len(rows):
        raise DataError(
            f"{lacking[0]}: has no {key!r}, which {len(rows) - len(lacking)} of {len(rows)} frames have. Complete it, "
            "or take it out of all."
        )
    return not lacking


def _pictures_in_words(frames: int, rows: int, spare_masks: int, masks: str) -> str:
    text = f"images/, all {frames}"
    if rows > frames:
        text += f"; {rows - frames} of the {rows} rows of {METADATA} have no picture and are left out"
    if spare_masks:
        text += f"; {spare_masks} files of {masks}/ belong to no picture and are left out"
    return text


def _shapes_in_words(rows: list[Mapping[str, Any]]) -> str:
    count = len({repr(row.get("betas")) for row in rows})
    return "the same in all frames" if count == 1 else f"{count} shapes, each frame its own"


def _others(folder: Path, masks: str) -> str:
    read = {METADATA, "images", masks}
    try:
        names = sorted({path.name for path in folder.iterdir()} - read, key=natural)
    except OSError:
        return ""
    known = [f"{name} ({NOT_READ[name]})" for name in names if name in NOT_READ]
    strange = [name for name in names if name not in NOT_READ]
    if strange:
        known.append("not looked at: " + ", ".join(strange[:12]) + (" …" if len(strange) > 12 else ""))
    return "; ".join(known)
