"""The files of a ZJU-MoCap sequence with `annots.npy`: the original release and the refined one.

| | original, `CoreView_377` | original, `CoreView_313` and `_315` | refined, `my_377` |
|---|---|---|---|
| pictures | `Camera_B1/000000.jpg` | `Camera (1)/CoreView_313_Camera_(1)_0001_<time>.jpg` | `images/00/000000.jpg` |
| body | `new_params/{i}.npy`, else `params/` | the same, i from 1 | `smpl_params/{i}.npy` |
| its vertices | `new_vertices/{i}.npy`, `vertices/` | the same | `smpl_vertices/{i}.npy` |
| masks | `mask/<picture's path>.png`, `mask_cihp/` | the same | the path with `mask` or `schp` in place of `images` |

The body's number i is the one in the picture's name. `params/` is the first fit, made without pose blend shapes;
`new_params/` is the second, made with them: Animatable NeRF, HumanNeRF, ARAH and OccNeRF read it for all subjects,
Neural Body's own settings still read `params/`. Embedded scenes with occluders also have `images_complete/` and
`mask_complete/`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from occfusion.data.body_convention import read_body
from occfusion.data.folder_contents import MAX_DIGITS
from occfusion.data.scene import Array, BodyParameters, Calibration, PictureFiles, Scene, Surface, Taken
from occfusion.data.zju.annots import Annots
from occfusion.errors import ConfigError, DataError
from occfusion.files.arrays import load_npy
from occfusion.synth.manifest import MANIFEST, written_spec
from occfusion.synth.spec import SceneSpec

if TYPE_CHECKING:
    from occfusion.synth.actor import Actor

KEPT_FRAMES = 64
"""Surfaces held in memory, 0.3 MB each: held-out views come camera by camera, so the same few moments recur."""
KEPT_FILES = 2048
"""Pictures whose paths are kept: they are asked for ten times before training, and take 60 microseconds."""


def true_surface(folder: Path) -> Callable[[int], Surface] | None:
    """Returns what gives the surface at a moment, clothes and hair included; None where it is not known.

    It is known of scenes that this version of the generator has written. Nothing is built before the first call.
    """
    if not (folder / MANIFEST).is_file():
        return None
    spec = written_spec(folder)
    if spec is None:
        return None

    @lru_cache(maxsize=KEPT_FRAMES)
    def surface(frame: int) -> Surface:
        actor = _actor(spec)
        return Surface(actor.vertices(frame)[0], actor.figure.faces)

    return surface


@lru_cache(maxsize=2)
def _actor(spec: SceneSpec) -> Actor:
    # of embedded people alone, and only where their truth is asked for
    from occfusion.synth.actor import Actor

    return Actor(spec)


MASK_FOLDERS = ("mask", "mask_cihp", "schp")

_STAMPED = re.compile(r"(?:[^_]*_){4}(\d+)(?:_|\Z)")
"""Names of 313 and 315: the fifth word is the number of the moment, from 1."""

_NAMED = 6
"""Folders and numbers named in a sentence before it says how many more there are."""


@dataclass(frozen=True)
class Fit:
    """A fit of the body that a release comes with.

    Attributes:
        vertices: folder of the vertices that belong to it.
        blended: whether it was made with pose blend shapes.
        words: what it is, for messages.
    """

    vertices: str
    blended: bool
    words: str


FITS = {
    "smpl_params": Fit("smpl_vertices", True, "the fit of the refined release"),
    "new_params": Fit("new_vertices", True, "the newer fit, made with pose blend shapes"),
    "params": Fit("vertices", False, "the older fit, made without pose blend shapes"),
}
"""Fits by the folder of their parameters, the newest first."""

AUTO_FIT = "auto"


ORIGINAL_FITS = ("new_params", "params")
"""Folders of body parameters in the original release; the first that exists is used, never a mixture."""

PICTURES = "images"
"""Folder of the refined release whose name that of the masks replaces; in the original it is put in front."""


class ZjuScene(Scene):
    """A sequence with `annots.npy`.

    `fit_name` is the folder of the body parameters that are read, a key of `FITS`.
    """

    def __init__(
        self,
        folder: Path,
        pelvis: Callable[[Array], Array],
        masks: str = "mask",
        *,
        refined: bool = False,
        fit: str = AUTO_FIT,
    ) -> None:
        """Reads `annots.npy`, and looks at which folders and files of body parameters there are.

        Args:
            folder: the sequence's folder.
            pelvis: gives the pelvis at rest, `[3]` in metres, for shape coefficients `[B]`.
            masks: mask folder, or several joined by `+`.
            refined: the layout is that of the refined release.
            fit: folder of the body parameters, a key of `FITS`; `auto` takes the newest that is there.

        Raises:
            ConfigError: an unknown mask folder or fit.
            DataError: the file, a key or a folder is missing, or what it holds cannot be.
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
        self._refined = refined
        self.fit_name = self._find_fit(fit)
        self._annots = Annots(folder / "annots.npy")
        self.num_frames = len(self._annots.pictures)
        self.cameras = self._annots.cameras
        self._numbers = [frame_number(row[0], position) for position, row in enumerate(self._annots.pictures)]
        self._has_truth = (folder / "mask_complete").is_dir()
        surface = true_surface(folder)
        if surface is not None:
            self.surface = lambda frame: surface(self._numbers[frame])
        self._files = lru_cache(KEPT_FILES)(self._make_files)
        self.taken = self._describe()

    @property
    def fit(self) -> Fit:
        """The fit that is read."""
        return FITS[self.fit_name]

    def _find_fit(self, fit: str) -> str:
        known = tuple(FITS) if self._refined else ORIGINAL_FITS
        there = [name for name in known if (self.root / name).is_dir()]
        if fit == AUTO_FIT:
            return (there or known)[0]
        if fit not in FITS:
            raise ConfigError(f"dataset.fit={fit!r}: choose {AUTO_FIT}, {', '.join(FITS)}.")
        if fit not in there:
            raise DataError(
                f"{self.root}: has no folder {fit} (dataset.fit={fit}); it has {', '.join(there) or 'none'}: choose "
                f"dataset.fit={(there or [AUTO_FIT])[0]}."
            )
        return fit

    def _describe(self) -> Taken:
        stamped = _STAMPED.match(PurePosixPath(self._annots.pictures[0][0]).stem) is not None
        release = "refined ZJU-MoCap" if self._refined else "original ZJU-MoCap"
        names = " (names with time stamps, as those of 313 and 315)" if stamped else ""
        embedded = "" if self.surface is None else "an embedded scene in the layout of "
        words = f", {self.fit.words}" if self.surface is None else ""
        masks = " or ".join(f"{name}/" for name in self._masks)
        return Taken(
            layout=f"{embedded}{release}{names}",
            pictures=f"the {self.num_frames} moments of annots.npy{self._without_body()}",
            body=f"{self.fit_name}/{{i}}.npy{words}; i is the number in the picture's name, the first "
            f"{self._numbers[0]}; turned about the origin (EasyMocap)",
            shape=f"`shapes` of {self.fit_name}/, moment by moment",
            masks=f"{masks}: every value or colour but 0 is the person",
            cameras=f"annots.npy: {len(self.cameras)}, which stand still{self._without_pictures()}",
            centres="0 (OpenCV)",
            others="; ".join(self._not_read()),
        )

    def _without_body(self) -> str:
        """Returns what to say of moments without a file of body parameters: they cannot be used."""
        folder = self.root / self.fit_name
        files = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        lost = [number for number in self._numbers if f"{number}.npy" not in files]
        return f"; {len(lost)} of them have no body in {folder.name}/: {_some(lost)}" if lost else ""

    def _without_pictures(self) -> str:
        paths = zip(self.cameras, self._annots.pictures[0], strict=True)
        missing = [camera for camera, path in paths if not (self.root / path).parent.is_dir()]
        return f"; there are no pictures of {len(missing)}: {_some(missing)}" if missing else ""

    def _not_read(self) -> list[str]:
        """Returns what else lies there that a setting would read."""
        fits = [name for name in FITS if name != self.fit_name and (self.root / name).is_dir()]
        masks = [name for name in MASK_FOLDERS if name not in self._masks and (self.root / name).is_dir()]
        found = [f"{name}/, {FITS[name].words} (dataset.fit={name})" for name in fits]
        return found + [f"{name}/ (dataset.masks={name})" for name in masks]

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
        return self._files(frame, camera)

    def _make_files(self, frame: int, camera: int) -> PictureFiles:
        picture = PurePosixPath(self._annots.pictures[frame][camera])
        known = self._has_truth
        return PictureFiles(
            name=picture.with_suffix("").as_posix(),
            rgb=self.root / picture,
            masks=tuple(self._beside(folder, picture).with_suffix(".png") for folder in self._masks),
            complete_rgb=self._beside("images_complete", picture) if known else None,
            complete_mask=self._beside("mask_complete", picture).with_suffix(".png") if known else None,
            any_value=True,
        )

    def evidence(self, frame: int) -> tuple[Path, ...]:
        """Returns `annots.npy` and the frame's body parameters."""
        return self._annots.path, self._parameter_file(frame)

    def vertices_file(self, frame: int) -> Path:
        """Returns where the vertices of the fit lie at a frame, `[V, 3]`, world, metres; it need not exist."""
        return self.root / self.fit.vertices / f"{self._numbers[frame]}.npy"

    def _parameter_file(self, frame: int) -> Path:
        return self.root / self.fit_name / f"{self._numbers[frame]}.npy"

    def _beside(self, folder: str, picture: PurePosixPath) -> Path:
        """Returns where `folder` keeps what belongs to a picture."""
        if self._refined and picture.parts[0] == PICTURES:
            picture = picture.relative_to(PICTURES)
        return self.root / folder / picture


def frame_number(picture: str, position: int) -> int:
    """Returns the number of a moment: from the picture's name where that has one, else its position."""
    stem = PurePosixPath(picture).stem
    stamped = _STAMPED.match(stem)
    digits = stem if stamped is None else stamped[1]
    return int(digits) if digits.isdecimal() and len(digits) <= MAX_DIGITS else position


def _some(things: Sequence[object]) -> str:
    more = len(things) - _NAMED
    return ", ".join(map(str, things[:_NAMED])) + (f" and {more} more" if more > 0 else "")
