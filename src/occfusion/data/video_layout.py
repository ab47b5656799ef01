"""One's own footage, in the form that PeopleSnapshot and NeuMan have come to: one camera, one folder.

| file | content |
|---|---|
| `cameras.npz` | `intrinsic` 3 x 3, `extrinsic` 4 x 4 (world to camera, metres; or one a frame), `height`, `width` |
| `poses.npz` | `betas` 1 x B, `global_orient` N x 3, `body_pose` N x 69, `transl` N x 3, or as in `pose_table.py` |
| `images/`, `masks/` | N pictures and their masks; partners have the same name or the same last number |

Principal points count pixel centres as +0.5, as COLMAP's do; `poses_optimized.npz` is read where there is
no `poses.npz`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from occfusion.data import checks
from occfusion.data.fixed_camera import FixedCamera
from occfusion.data.humannerf_layout import need
from occfusion.data.listing import partners, pictures_in
from occfusion.data.pose_table import WIDTHS, read_pose_table
from occfusion.data.scene import Array, BodyParameters, Calibration, PictureFiles, Scene
from occfusion.errors import DataError
from occfusion.files.arrays import load_npz
from occfusion.files.images import image_size

POSE_FILES = ("poses.npz", "poses_optimized.npz")


class VideoScene(Scene):
    """A folder with `cameras.npz` and `poses.npz`."""

    def __init__(
        self,
        folder: Path,
        pelvis: Callable[[Array], Array],
        masks: str = "masks",
        person: int | None = None,
        *,
        occluded: bool = True,
    ) -> None:
        """Reads cameras and poses and lists the pictures.

        Args:
            folder: the sequence's folder.
            pelvis: gives the pelvis at rest, `[3]` in metres, for shape coefficients `[B]`.
            masks: mask folder.
            person: the value of the wanted person in masks that number several.
            occluded: whether things may stand before the person.

        Raises:
            DataError: a file, key or frame is missing, or what they hold cannot be.
        """
        self.name, self.root = folder.name, folder
        self._pelvis, self._person, self._occluded = pelvis, person, occluded
        there = [name for name in POSE_FILES if (folder / name).is_file()]
        self._poses_file = folder / (there or POSE_FILES)[0]
        images = pictures_in(folder / "images")
        self._names, self._pictures = list(images), list(images.values())
        self._masks = partners(self._names, pictures_in(folder / masks), folder / masks)
        self.num_frames, self.cameras = len(self._names), ("camera",)
        self._poses = read_pose_table(self._poses_file, self.num_frames, folder / "images")
        self._camera = self._read_camera()

    def calibration(self, camera: int) -> Calibration:
        """Returns the one camera there is."""
        return self._camera.calibration

    def parameters(self, frame: int) -> BodyParameters:
        """Returns the body of a frame."""
        where = f"{self._poses_file}, row {frame}"
        values = {
            key: checks.numbers(self._poses[key][frame], width, f"{where}, {key}")
            for key, width in WIDTHS.items()
        }
        betas = self._poses["betas"]
        betas = betas[frame if len(betas) == self.num_frames else 0]
        betas = checks.shape_numbers(betas, f"{where}, betas")
        body = BodyParameters(betas, values["global_orient"], values["body_pose"], values["transl"])
        return self._camera.carry(frame, body, self._pelvis(betas))

    def files(self, frame: int, camera: int) -> PictureFiles:
        """Returns the paths of one picture and its mask."""
        mask = self._masks[frame]
        return PictureFiles(
            self._names[frame], self._pictures[frame], (mask,), None, None, self._occluded, self._person
        )

    def evidence(self, frame: int) -> tuple[Path, ...]:
        """Returns the two tables."""
        return self.root / "cameras.npz", self._poses_file

    def _read_camera(self) -> FixedCamera:
        file = self.root / "cameras.npz"
        content = load_npz(file)
        where = [f"{file}, {name}" for name in self._names]
        given = {key: np.asarray(need(content, key, str(file))) for key in ("intrinsic", "extrinsic")}
        rows = {}
        for key, value in given.items():
            if value.ndim == 2:
                rows[key] = [value] * self.num_frames
            elif value.ndim == 3 and len(value) in (1, self.num_frames):
                rows[key] = list(value) * (self.num_frames // len(value))
            else:
                raise DataError(
                    f"{file}, {key} has shape {value.shape}; give one matrix, or one for each of the "
                    f"{self.num_frames} pictures."
                )
        self._check_size(content, file)
        bent = content.get("distortion")
        distortions = None if bent is None else [bent] * self.num_frames
        return FixedCamera("camera", rows["intrinsic"], rows["extrinsic"], distortions, where, 0.0)

    def _check_size(self, content: dict[str, np.ndarray], file: Path) -> None:
        """Raises DataError when the camera was calibrated for pictures of another size."""
        if "width" not in content or "height" not in content:
            return
        declared = [int(checks.numbers(content[key], 1, f"{file}, {key}")[0]) for key in ("width", "height")]
        actual = list(image_size(self._pictures[0]))
        if declared != actual:
            raise DataError(
                f"{file}: calibrated for {declared[0]} x {declared[1]} pixels, but {self._pictures[0].name} has "
                f"{actual[0]} x {actual[1]}; scale intrinsic with the pictures, and correct width and height."
            )
