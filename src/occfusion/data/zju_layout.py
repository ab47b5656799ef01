"""The files of a ZJU-MoCap sequence with `annots.npy`: the original release and the refined one.

| | original, `CoreView_377` | original, `CoreView_313` and `_315` | refined, `my_377` |
|---|---|---|---|
| pictures | `Camera_B1/000000.jpg` | `Camera (1)/CoreView_313_Camera_(1)_0001_<time>.jpg` | `images/00/000000.jpg` |
| body | `new_params/{i}.npy`, else `params/` | `params/{i}.npy`, i from 1, else `new_params/` | `smpl_params/{i}.npy` |
| masks | `mask/<picture's path>.png`, `mask_cihp/` | the same | the path with `mask` in place of `images` |

The body's number i is the one in the picture's name. Embedded scenes with occluders also have
`images_complete/` and `mask_complete/`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from occfusion.data.annots import Annots
from occfusion.data.easymocap import read_body
from occfusion.data.listing import MAX_DIGITS
from occfusion.data.scene import Array, BodyParameters, Calibration, PictureFiles, Scene, Taken
from occfusion.data.true_surface import true_surface
from occfusion.errors import ConfigError, DataError
from occfusion.files.arrays import load_npy

MASK_FOLDERS = ("mask", "mask_cihp", "schp")

_STAMPED = re.compile(r"(?:[^_]*_){4}(\d+)(?:_|\Z)")
"""Names of 313 and 315: the fifth word is the number of the moment, from 1."""


@dataclass(frozen=True)
class Release:
    """Where a release keeps things.

    Attributes:
        params: folders of body parameters; the first that exists is used, never a mixture.
        pictures: folder whose name the masks' folder replaces; empty where it is put in front.
    """

    params: tuple[str, ...]
    pictures: str = ""


ORIGINAL = Release(("new_params", "params"))
STAMPED = Release(("params", "new_params"))
REFINED = Release(("smpl_params", "new_params", "params"), "images")


class ZjuScene(Scene):
    """A sequence with `annots.npy`."""

    def __init__(
        self,
        folder: Path,
        pelvis: Callable[[Array], Array],
        masks: str = "mask",
        *,
        refined: bool = False,
    ) -> None:
        """Reads `annots.npy` and nothing else.

        Args:
            folder: the sequence's folder.
            pelvis: gives the pelvis at rest, `[3]` in metres, for shape coefficients `[B]`.
            masks: mask folder, or several joined by `+`.
            refined: the layout is that of the refined release.

        Raises:
            ConfigError: an unknown mask folder.
            DataError: the file or a key is missing, or what it holds cannot be.
        """
        self.name, self.root = folder.name, folder
        self._pelvis = pelvis
        self._masks = tuple(masks.split("+"))
        unknown = [name for name in self._masks if name not in MASK_FOLDERS]
        if unknown:
            raise ConfigError(
                f"dataset.masks={masks!r}: choose {', '.join(MASK_FOLDERS)}, or several joined by +, "
                "as in mask+mask_cihp."
            )
        self._require_masks(masks)
        self._annots = Annots(folder / "annots.npy")
        self.num_frames = len(self._annots.pictures)
        self.cameras = self._annots.cameras
        stamped = _STAMPED.match(PurePosixPath(self._annots.pictures[0][0]).stem) is not None
        self._release = REFINED if refined else STAMPED if stamped else ORIGINAL
        there = [name for name in self._release.params if (folder / name).is_dir()]
        self._params = folder / (there or self._release.params)[0]
        self._numbers = [frame_number(row[0], position) for position, row in enumerate(self._annots.pictures)]
        self._has_truth = (folder / "mask_complete").is_dir()
        self.taken = Taken(
            layout="refined ZJU-MoCap" if refined else "original ZJU-MoCap",
            pictures=f"the {self.num_frames} moments of annots.npy",
            body=f"{self._params.name}/",
            shape=f"`shapes` of {self._params.name}/",
            masks=masks,
            cameras="annots.npy",
            centres="0 (OpenCV)",
        )
        if (surface := true_surface(folder)) is not None:
            self.surface = lambda frame: surface(self._numbers[frame])

    def _require_masks(self, masks: str) -> None:
        there = [name for name in MASK_FOLDERS if (self.root / name).is_dir()]
        missing = [name for name in self._masks if name not in there]
        if missing and there:
            raise DataError(
                f"{self.root}: has no folder {missing[0]} (dataset.masks={masks}); it has {', '.join(there)}: "
                f"choose dataset.masks={'+'.join(there)}."
            )

    def calibration(self, camera: int) -> Calibration:
        """Returns a camera in metres, with pixel centres at +0.5; its rotation is checked."""
        return self._annots.calibration(camera)

    def parameters(self, frame: int) -> BodyParameters:
        """Returns the body of a frame in the convention of smplx, from `Rh`, `Th`, `poses`, `shapes`."""
        path = self._parameter_file(frame)
        return read_body(load_npy(path), self._pelvis, str(path))

    def files(self, frame: int, camera: int) -> PictureFiles:
        """Returns the paths of one picture and its masks."""
        picture = PurePosixPath(self._annots.pictures[frame][camera])
        known = self._has_truth
        return PictureFiles(
            name=picture.with_suffix("").as_posix(),
            rgb=self.root / picture,
            masks=tuple(self._beside(folder, picture).with_suffix(".png") for folder in self._masks),
            complete_rgb=self._beside("images_complete", picture) if known else None,
            complete_mask=self._beside("mask_complete", picture).with_suffix(".png") if known else None,
        )

    def evidence(self, frame: int) -> tuple[Path, ...]:
        """Returns `annots.npy` and the frame's body parameters."""
        return self._annots.path, self._parameter_file(frame)

    def _parameter_file(self, frame: int) -> Path:
        return self._params / f"{self._numbers[frame]}.npy"

    def _beside(self, folder: str, picture: PurePosixPath) -> Path:
        """Returns where `folder` keeps what belongs to a picture."""
        if self._release.pictures and picture.parts[0] == self._release.pictures:
            picture = picture.relative_to(self._release.pictures)
        return self.root / folder / picture


def frame_number(picture: str, position: int) -> int:
    """Returns the number of a moment: from the picture's name where that has one, else its position."""
    stem = PurePosixPath(picture).stem
    stamped = _STAMPED.match(stem)
    digits = stem if stamped is None else stamped[1]
    return int(digits) if digits.isdecimal() and len(digits) <= MAX_DIGITS else position
