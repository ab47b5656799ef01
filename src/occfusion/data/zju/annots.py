"""`annots.npy` of ZJU-MoCap: the cameras, and the picture of each camera at each moment.

| key | content |
|---|---|
| `cams` | lists over cameras: `K` 3 x 3, `R` 3 x 3, `T` 3 x 1 in millimetres, `D` 5 x 1 |
| `ims` | list over moments of `{"ims": [relative path of each camera's picture]}` |
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from occfusion.data.cameras import OPENCV_CENTRE
from occfusion.data.checking import checks
from occfusion.data.folder_contents import inside
from occfusion.data.scene import Calibration
from occfusion.errors import DataError
from occfusion.files.arrays import load_npy

MILLIMETRES = 1000.0

_CAMERA_KEYS = {"K": 9, "R": 9, "T": 3}


class Annots:
    """The content of one `annots.npy`, its structure checked; cameras are checked when asked for.

    Attributes:
        path: the file.
        pictures: relative path of each camera's picture at each moment.
        cameras: what the cameras are called: the folders of their pictures.
    """

    def __init__(self, path: Path) -> None:
        """Reads the file.

        Raises:
            DataError: it is missing, unsafe or damaged, a key is missing, lists differ in length, a path
                leads out of the folder, or the translations are in metres.
        """
        self.path = path
        cams, moments = mapping(load_npy(path), ("cams", "ims"), path)
        self._cams = self._camera_lists(cams)
        self.pictures = self._picture_paths(moments, len(self._cams["K"]))
        self.cameras = tuple(PurePosixPath(name).parent.as_posix() for name in self.pictures[0])
        checks.check_millimetres(
            np.stack([checks.numbers(T, 3, self._at("T", i)) for i, T in enumerate(self._cams["T"])]),
            f"{path}, cams.T",
        )

    def calibration(self, camera: int) -> Calibration:
        """Returns a camera in metres, with pixel centres at +0.5; its rotation is checked."""
        values = {
            key: checks.numbers(self._cams[key][camera], size, self._at(key, camera))
            for key, size in _CAMERA_KEYS.items()
        }
        K = values["K"].reshape(3, 3).copy()
        K[:2, 2] += OPENCV_CENTRE
        return Calibration(
            name=self.cameras[camera],
            K=K,
            R=checks.rotation(values["R"].reshape(3, 3), self._at("R", camera)),
            t=values["T"] / MILLIMETRES,
            distortion=checks.distortion(self._cams["D"][camera], self._at("D", camera)),
        )

    def _at(self, key: str, camera: int) -> str:
        return f"{self.path}, cams.{key}[{camera}]"

    def _camera_lists(self, cams: Any) -> dict[str, Any]:
        lists = {}
        keys = ("K", "R", "T", "D")
        for key, values in zip(keys, mapping(cams, keys, self.path, "cams."), strict=True):
            if not _is_list(values) or len(values) == 0:
                raise DataError(f"{self.path}: cams.{key} must be a list with one entry a camera.")
            lists[key] = values
        counts = {key: len(values) for key, values in lists.items()}
        if len(set(counts.values())) != 1:
            raise DataError(f"{self.path}: cams.K, R, T and D differ in length: {counts}.")
        return lists

    def _picture_paths(self, moments: Any, cameras: int) -> list[tuple[str, ...]]:
        if not _is_list(moments) or len(moments) == 0:
            raise DataError(f"{self.path}: ims must be a list with one entry a frame.")
        paths = []
        for frame, moment in enumerate(moments):
            (names,) = mapping(moment, ("ims",), self.path, f"ims[{frame}].")
            if not _is_list(names):
                raise DataError(f"{self.path}: ims[{frame}].ims must be a list with one picture a camera.")
            if len(names) != cameras:
                raise DataError(
                    f"{self.path}: ims[{frame}].ims names {len(names)} pictures for {cameras} cameras."
                )
            paths.append(tuple(inside(name, f"{self.path}: ims[{frame}]") for name in names))
        return paths


def mapping(content: Any, keys: tuple[str, ...], path: Path, prefix: str = "") -> list[Any]:
    """Returns the values of `keys`.

    Raises:
        DataError: no dict, or a key is missing; names the first.
    """
    if not isinstance(content, Mapping):
        raise DataError(f"{path}: {prefix or 'the file'} holds a {type(content).__name__}, not a dict.")
    for key in keys:
        if key not in content:
            known = ", ".join(str(k) for k in content) or "nothing"
            raise DataError(
                f"{path}: key {prefix}{key} is missing; there is {known[:200]}. Is this a ZJU-MoCap scene?"
            )
    return [content[key] for key in keys]


def _is_list(value: Any) -> bool:
    return isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.ndim > 0)
