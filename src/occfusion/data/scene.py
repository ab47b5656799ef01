"""What a reader of a data folder gives: cameras, body parameters and the paths of pictures.

A reader knows one layout on disk and nothing of scaling, occlusion or training; those are shared.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Calibration:
    """A camera as calibrated: pinhole with lens distortion, OpenCV axes.

    Attributes:
        name: what messages call it.
        K: intrinsics in pixels, pixel centres at +0.5, `[3, 3]`.
        R: rotation from world to camera, `[3, 3]`.
        t: translation from world to camera, `[3]`, metres.
        distortion: OpenCV's k1 k2 p1 p2 k3 (or 4, or 8 of them).
    """

    name: str
    K: Array
    R: Array
    t: Array
    distortion: Array

    @property
    def centre(self) -> Array:
        """Returns the camera centre in the world, `[3]`, metres."""
        return -self.R.T @ self.t


@dataclass(frozen=True)
class BodyParameters:
    """Parameters of one frame in the convention of smplx (rotation about the pelvis); metres, radians.

    Attributes:
        betas: `[B]`.
        global_orient: `[3]`.
        body_pose: `[69]`.
        transl: `[3]`.
    """

    betas: Array
    global_orient: Array
    body_pose: Array
    transl: Array


@dataclass(frozen=True)
class PictureFiles:
    """Where one moment of one camera lies on disk.

    Attributes:
        name: what errors and tables call it.
        rgb: the picture.
        masks: person masks; a pixel in any of them is the person.
        complete_rgb: the picture without its occluder, where the data set has one.
        complete_mask: the whole person, hidden parts included, where the data set has it.
        occluded: whether real things may stand before the person.
        label: the value of the wanted person in masks that number several; None: every value but 0.
        any_value: whether even the faintest value of a soft mask is the person, as its data set's own code has it.
    """

    name: str
    rgb: Path
    masks: tuple[Path, ...]
    complete_rgb: Path | None
    complete_mask: Path | None
    occluded: bool = False
    label: int | None = None
    any_value: bool = False

    @property
    def truth_unknown(self) -> bool:
        """Whether something may hide part of the person and nothing tells what."""
        return self.occluded and self.complete_mask is None

    def all(self) -> tuple[Path, ...]:
        """Returns every path."""
        optional = (self.complete_rgb, self.complete_mask)
        return (self.rgb, *self.masks, *(path for path in optional if path is not None))


class Surface(NamedTuple):
    """What the cameras truly saw of the person at a moment, as a mesh.

    Attributes:
        vertices: in the world, `[V, 3]`, metres.
        faces: `[F, 3]`.
    """

    vertices: Array
    faces: NDArray[np.int64]


@dataclass(frozen=True)
class Taken:
    """What a reader took of a folder, in words: a folder often holds several answers, and a run must say which it used.

    Attributes:
        layout: its name, and whose program writes it.
        pictures: folder, how many of how many, and why the others were dropped.
        body: file or folder of the poses, which of several, and by which rule they are read.
        shape: where the shape coefficients come from.
        masks: folder, and which values are the person.
        cameras: file, and whether the camera stands still.
        centres: where the middle of the first pixel is for the principal points as they are stored.
        others: what else lies there and was not read, and how to ask for it; empty where there is nothing.
    """

    layout: str
    pictures: str
    body: str
    shape: str
    masks: str
    cameras: str
    centres: str
    others: str = ""

    def lines(self) -> list[str]:
        """Returns a line each, `name: what`, without those that say nothing."""
        return [f"{name}: {text}" for name, text in asdict(self).items() if text]


class Scene(ABC):
    """An interface: one sequence of one person, seen by one or more cameras.

    `taken` says what was read; `remarks` are sentences about the folder that the user should know of, one each;
    `surface` gives the person's true surface at a frame of the sequence, for evaluation, and is None where nobody
    knows it; `zooms` says that a camera's K is not the same in all frames, so that `view` must be asked.
    """

    name: str
    root: Path
    num_frames: int
    cameras: tuple[str, ...]
    taken: Taken
    remarks: tuple[str, ...] = ()
    surface: Callable[[int], Surface] | None = None
    zooms: bool = False

    @abstractmethod
    def calibration(self, camera: int) -> Calibration:
        """Returns a camera, checked on its own."""

    def view(self, frame: int, camera: int) -> Calibration:
        """Returns a camera as it was at a frame: that of `calibration`, unless its lens zoomed."""
        return self.calibration(camera)

    def shows(self, frame: int, camera: int) -> bool:
        """Whether the folder is meant to have a picture of a camera at a frame."""
        return True

    @abstractmethod
    def parameters(self, frame: int) -> BodyParameters:
        """Returns the body parameters of a frame, checked on their own."""

    @abstractmethod
    def files(self, frame: int, camera: int) -> PictureFiles:
        """Returns the paths of one picture; they need not exist."""

    @abstractmethod
    def evidence(self, frame: int) -> tuple[Path, ...]:
        """Returns the files, other than pictures, that determine a frame: for the hash of the data."""

    def body_warnings(self, pose: Callable[[BodyParameters], tuple[Array, Array]]) -> list[str]:
        """Returns what joints that the folder itself has say against a body, one sentence each.

        Args:
            pose: gives the body's vertices `[V, 3]` and joints `[24, 3]` in the world, metres.

        Raises:
            DataError: the parameters were certainly fitted with another body.
        """
        return []
