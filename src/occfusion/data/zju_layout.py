"""The files of a ZJU-MoCap sequence as released: `annots.npy`, pictures by camera, `params/`, `mask/`.

| read | rule |
|---|---|
| cameras | `annots.npy`: `cams` with lists `K`, `R`, `T` (millimetres), `D`; `ims`: relative paths |
| body | `new_params/` (a later fit) when that folder exists, else `params/`; never a mixture |
| masks | `mask/<picture's path>.png`, or `mask_cihp`, or both joined as `mask+mask_cihp` |
| truth | `images_complete/` and `mask_complete/` where a scene was rendered with occluders |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from occfusion.data import checks
from occfusion.data.convention import easymocap_to_smplx
from occfusion.data.lens import OPENCV_CENTRE
from occfusion.data.scene import Array, BodyParameters, Calibration, PictureFiles, Scene
from occfusion.errors import ConfigError, DataError
from occfusion.files.arrays import load_npy

MILLIMETRES = 1000.0
MASK_FOLDERS = ("mask", "mask_cihp")
_CAMERA_KEYS = {"K": 9, "R": 9, "T": 3}
_DISTORTION_SIZES = (4, 5, 8)
_BODY_KEYS = {"poses": 72, "Rh": 3, "Th": 3}


class ZjuScene(Scene):
    """A sequence in the original layout of ZJU-MoCap."""

    def __init__(self, root: Path, name: str, pelvis: Callable[[Array], Array], masks: str = "mask") -> None:
        """Reads `annots.npy` and nothing else.

        Args:
            root: the folder that holds the sequences.
            name: the sequence's folder.
            pelvis: gives the pelvis at rest, `[3]` in metres, for shape coefficients `[B]`.
            masks: mask folder, or several joined by `+`.

        Raises:
            ConfigError: an unknown mask folder.
            DataError: the folder, the file or a key is missing, or what it holds cannot be.
        """
        self.name = name
        self.root = root / name
        self._pelvis = pelvis
        self._masks = tuple(masks.split("+"))
        unknown = [folder for folder in self._masks if folder not in MASK_FOLDERS]
        if unknown:
            raise ConfigError(f"dataset.masks={masks!r}: choose mask, mask_cihp or mask+mask_cihp.")
        if not self.root.is_dir():
            raise DataError(f"{self.root}: no such folder; dataset.root={root} has {_folders(root)}.")
        self._annots = self.root / "annots.npy"
        content = load_npy(self._annots)
        cams, moments = _mapping(content, ("cams", "ims"), self._annots)
        self._cams = self._camera_lists(cams)
        self._paths = self._picture_paths(moments, len(self._cams["K"]))
        self.num_frames = len(self._paths)
        self.cameras = tuple(PurePosixPath(path).parent.as_posix() for path in self._paths[0])
        checks.check_millimetres(
            np.stack([checks.numbers(T, 3, self._at("T", i)) for i, T in enumerate(self._cams["T"])]),
            f"{self._annots}, cams.T",
        )
        folder = "new_params" if (self.root / "new_params").is_dir() else "params"
        self._params = self.root / folder

    def calibration(self, camera: int) -> Calibration:
        """Returns a camera in metres, with pixel centres at +0.5; its rotation is checked."""
        values = {
            key: checks.numbers(self._cams[key][camera], size, self._at(key, camera))
            for key, size in _CAMERA_KEYS.items()
        }
        distortion = np.asarray(self._cams["D"][camera])
        if distortion.size not in _DISTORTION_SIZES:
            raise DataError(f"{self._at('D', camera)} has {distortion.size} numbers, expected 5.")
        K = values["K"].reshape(3, 3).copy()
        K[:2, 2] += OPENCV_CENTRE
        return Calibration(
            name=self.cameras[camera],
            K=K,
            R=checks.rotation(values["R"].reshape(3, 3), self._at("R", camera)),
            t=values["T"] / MILLIMETRES,
            distortion=checks.numbers(distortion, distortion.size, self._at("D", camera)),
        )

    def parameters(self, frame: int) -> BodyParameters:
        """Returns the body of a frame in the convention of smplx, from `Rh`, `Th`, `poses`, `shapes`."""
        path = self._parameter_file(frame)
        content = load_npy(path)
        if not isinstance(content, Mapping):
            raise DataError(f"{path}: holds a {type(content).__name__}, not a dict.")
        for key in (*_BODY_KEYS, "shapes"):
            if key not in content:
                raise DataError(f"{path}: key {key!r} is missing; it has {', '.join(map(str, content))}.")
        values = {
            key: checks.numbers(content[key], size, f"{path}, {key}") for key, size in _BODY_KEYS.items()
        }
        shape_count = int(np.size(content["shapes"]))
        betas = checks.numbers(content["shapes"], shape_count, f"{path}, shapes")
        poses = values["poses"]
        orient, transl = easymocap_to_smplx(values["Rh"], values["Th"], poses[:3], self._pelvis(betas))
        return BodyParameters(betas, orient, poses[3:], transl)

    def files(self, frame: int, camera: int) -> PictureFiles:
        """Returns the paths of one picture and its masks."""
        picture = PurePosixPath(self._paths[frame][camera])
        complete = self.root / "mask_complete" / picture.with_suffix(".png")
        known = (self.root / "mask_complete").is_dir()
        return PictureFiles(
            name=picture.with_suffix("").as_posix(),
            rgb=self.root / picture,
            masks=tuple(self.root / folder / picture.with_suffix(".png") for folder in self._masks),
            complete_rgb=self.root / "images_complete" / picture if known else None,
            complete_mask=complete if known else None,
        )

    def evidence(self, frame: int) -> tuple[Path, ...]:
        """Returns `annots.npy` and the frame's body parameters."""
        return self._annots, self._parameter_file(frame)

    def _parameter_file(self, frame: int) -> Path:
        return self._params / f"{frame}.npy"

    def _at(self, key: str, camera: int) -> str:
        return f"{self._annots}, cams.{key}[{camera}]"

    def _camera_lists(self, cams: Any) -> dict[str, Any]:
        lists = {}
        for key, values in zip(
            ("K", "R", "T", "D"), _mapping(cams, ("K", "R", "T", "D"), self._annots, "cams."), strict=True
        ):
            if not isinstance(values, (list, tuple, np.ndarray)) or len(values) == 0:
                raise DataError(f"{self._annots}: cams.{key} must be a list with one entry a camera.")
            lists[key] = values
        counts = {key: len(values) for key, values in lists.items()}
        if len(set(counts.values())) != 1:
            raise DataError(f"{self._annots}: cams.K, R, T and D differ in length: {counts}.")
        return lists

    def _picture_paths(self, moments: Any, cameras: int) -> list[tuple[str, ...]]:
        if not isinstance(moments, (list, tuple, np.ndarray)) or len(moments) == 0:
            raise DataError(f"{self._annots}: ims must be a list with one entry a frame.")
        paths = []
        for frame, moment in enumerate(moments):
            (names,) = _mapping(moment, ("ims",), self._annots, f"ims[{frame}].")
            if len(names) != cameras:
                raise DataError(
                    f"{self._annots}: ims[{frame}].ims names {len(names)} pictures for {cameras} cameras."
                )
            paths.append(tuple(self._inside(name, frame) for name in names))
        return paths

    def _inside(self, name: Any, frame: int) -> str:
        path = PurePosixPath(str(name).replace("\\", "/"))
        if path.is_absolute() or ".." in path.parts or not path.name or "\0" in str(path):
            raise DataError(
                f"{self._annots}: ims[{frame}] names {str(name)!r}, which leads out of the scene's folder."
            )
        return path.as_posix()


def _mapping(content: Any, keys: tuple[str, ...], path: Path, prefix: str = "") -> list[Any]:
    """Returns the values of `keys`, or names the first that is missing."""
    if not isinstance(content, Mapping):
        raise DataError(f"{path}: {prefix or 'the file'} holds a {type(content).__name__}, not a dict.")
    for key in keys:
        if key not in content:
            known = ", ".join(str(k) for k in content) or "nothing"
            raise DataError(
                f"{path}: key {prefix}{key} is missing; there is {known}. Is this a ZJU-MoCap scene?"
            )
    return [content[key] for key in keys]


def _folders(root: Path) -> str:
    if not root.is_dir():
        return "no such folder either"
    names = sorted(p.name for p in root.iterdir() if (p / "annots.npy").is_file())
    return "the sequences " + ", ".join(names[:20]) if names else "no folder with an annots.npy"
