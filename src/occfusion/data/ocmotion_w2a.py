"""OcMotion as Wild2Avatar cut it: `<sequence>_w2a/`, one camera, real occluders.

| file | content |
|---|---|
| `images/00000.png`, `masks/00000.png` | pictures; masks of the visible person, any channel, not 0 |
| `metadata.json` | `{picture: {poses, betas, trans, cam_intrinsics, cam_extrinsics}}` |

The convention is that of SMPL: the root's rotation is the first three of `poses`, and
`x = SMPL(poses, betas) + trans`. Other footage prepared for HumanNeRF has the same file, at times without
`trans`; its person then stands at the origin. `cameras.pkl`, `all_cameras.pkl` and `mesh_infos.pkl` beside it
say the same in HumanNeRF's form and are not read.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from occfusion.data import checks
from occfusion.data.fixed_camera import FixedCamera
from occfusion.data.humannerf_layout import entry, need, table
from occfusion.data.lens import OPENCV_CENTRE
from occfusion.data.listing import natural, partners, pictures_in, require_same
from occfusion.data.scene import Array, BodyParameters, Calibration, PictureFiles, Scene
from occfusion.files.jsonfile import load_json

METADATA = "metadata.json"


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
        rows = table(load_json(self._file), self._file)
        images = pictures_in(folder / "images")
        self._rows = {Path(name).stem: entry(rows, name, self._file) for name in rows}
        require_same(self._rows, str(self._file), images, str(folder / "images"))
        self._names = sorted(images, key=natural)
        self._pictures = [images[name] for name in self._names]
        self._masks = partners(self._names, pictures_in(folder / masks), folder / masks)
        self.num_frames, self.cameras = len(self._names), ("camera",)
        where = [self._where(frame) for frame in range(self.num_frames)]
        chosen = [self._rows[name] for name in self._names]
        self._camera = FixedCamera(
            "camera",
            [need(row, "cam_intrinsics", at) for row, at in zip(chosen, where, strict=True)],
            [need(row, "cam_extrinsics", at) for row, at in zip(chosen, where, strict=True)],
            None,
            where,
            OPENCV_CENTRE,
        )

    def calibration(self, camera: int) -> Calibration:
        """Returns the one camera there is."""
        return self._camera.calibration

    def parameters(self, frame: int) -> BodyParameters:
        """Returns the body of a frame."""
        row, where = self._rows[self._names[frame]], self._where(frame)
        poses = checks.numbers(need(row, "poses", where), 72, f"{where}, poses")
        betas = checks.shape_numbers(need(row, "betas", where), f"{where}, betas")
        transl = checks.numbers(row.get("trans", np.zeros(3)), 3, f"{where}, trans")
        body = BodyParameters(betas, poses[:3], poses[3:], transl)
        return self._camera.carry(frame, body, self._pelvis(betas))

    def files(self, frame: int, camera: int) -> PictureFiles:
        """Returns the paths of one picture and its mask."""
        name, mask = self._names[frame], self._masks[frame]
        return PictureFiles(name, self._pictures[frame], (mask,), None, None, True, self._person)

    def evidence(self, frame: int) -> tuple[Path, ...]:
        """Returns the table."""
        return (self._file,)

    def _where(self, frame: int) -> str:
        return f"{self._file}, {self._names[frame]}"
