"""From a reader and settings to what is trained on: frames, cameras, occlusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from occfusion.data import protocol, survey
from occfusion.data.occlusion import OcclusionSettings, plan
from occfusion.data.scene import PictureFiles, Scene
from occfusion.data.silhouette import Hidden
from occfusion.errors import DataError
from occfusion.files.images import read_numbers


@dataclass(frozen=True)
class Selection:
    """What the user asks for; None means the paper's protocol.

    Attributes:
        train_camera: index of the camera trained on.
        test_cameras: indices of the held-out cameras.
        train_frames: `[start, stop, step]`.
        test_frames: `[start, stop, step]`.
    """

    train_camera: int
    test_cameras: Sequence[int] | None
    train_frames: Sequence[int | None] | None
    test_frames: Sequence[int | None] | None


@dataclass(frozen=True)
class Prepared:
    """What is there and was selected, and what is hidden.

    Attributes:
        scene: the reader.
        train: training frames that show a person.
        people: what their masks show.
        hidden: the simulated occlusion of each, in pixels of the stored picture.
        left_out: training frames whose mask is empty.
        test: held-out frames.
        camera: the camera trained on.
        cameras: held-out cameras.
    """

    scene: Scene
    train: tuple[int, ...]
    people: tuple[survey.Person, ...]
    hidden: tuple[Hidden | None, ...]
    left_out: tuple[int, ...]
    test: tuple[int, ...]
    camera: int
    cameras: tuple[int, ...]

    @property
    def train_views(self) -> tuple[tuple[int, int], ...]:
        """The training `(frame, camera)`."""
        return tuple((frame, self.camera) for frame in self.train)

    @property
    def test_views(self) -> tuple[tuple[int, int], ...]:
        """The held-out `(frame, camera)`, camera by camera."""
        return tuple((frame, camera) for camera in self.cameras for frame in self.test)

    @property
    def unknown(self) -> tuple[bool, ...]:
        """Whether real things or other people may hide parts of the person that no file shows, by frame."""
        anything = self.scene.files(self.train[0], self.camera).truth_unknown
        return tuple(anything or person.crowded for person in self.people)

    def visible_shares(self) -> list[float]:
        """Returns which share of the known whole person each training frame shows."""
        return [p.visible_share(box) for p, box in zip(self.people, self.hidden, strict=True)]


def prepare(scene: Scene, selection: Selection, occlusion: OcclusionSettings) -> Prepared:
    """Returns what the selection means for this scene; reads the masks of the training frames.

    Raises:
        ConfigError: a frame range or camera that the scene has not.
        DataError: a training file is missing, no training frame shows a person, or all of it is hidden.
    """
    camera = selection.train_camera
    cameras = protocol.held_out_cameras(selection.test_cameras, camera, len(scene.cameras))
    wanted = protocol.train_range(selection.train_frames, scene.num_frames)
    held_out = protocol.held_out_range(selection.test_frames, scene.num_frames)
    if selection.test_frames is None:
        held_out = _shown(scene, cameras, held_out, wanted)
    survey.require_files(scene, ((frame, camera) for frame in wanted))
    found = survey.scan_people(scene, wanted, camera)
    shown = [(frame, person) for frame, person in zip(wanted, found, strict=True) if not person.whole.empty]
    if not shown:
        raise DataError(_nobody(scene.files(wanted[0], camera), len(wanted)))
    people = tuple(person for _, person in shown)
    train = tuple(frame for frame, _ in shown)
    result = Prepared(
        scene=scene,
        train=train,
        people=people,
        hidden=plan(occlusion, [person.whole for person in people], scene.name, train),
        left_out=tuple(frame for frame in wanted if frame not in set(train)),
        test=held_out,
        camera=camera,
        cameras=cameras,
    )
    if max(result.visible_shares()) == 0.0:
        raise DataError(
            f"{scene.root}: the person is hidden completely in every training frame; there is nothing to "
            "learn from. Make dataset.occlusion narrower."
        )
    return result


def _shown(
    scene: Scene, cameras: tuple[int, ...], held_out: tuple[int, ...], train: tuple[int, ...]
) -> tuple[int, ...]:
    """Returns the protocol's held-out frames, or where not all are shown those that are, along the training frames."""

    def all_there(frame: int) -> bool:
        return all(scene.shows(frame, camera) for camera in cameras)

    if all(map(all_there, held_out)):
        return held_out
    return tuple(frame for frame in range(train[0], train[-1] + 1) if all_there(frame)) or held_out


def _nobody(files: PictureFiles, frames: int) -> str:
    """Returns what to say where no training frame shows the person."""
    path = files.masks[0]
    if files.label is None:
        return (
            f"{path}: no person in this mask, nor in the masks of any of the {frames} training frames. Check "
            "dataset.masks, dataset.train_camera and dataset.train_frames."
        )
    values = [int(value) for value in np.unique(read_numbers(path)) if value]
    there = f"the values {', '.join(map(str, values[:12]))}" if values else "nobody"
    return (
        f"{path}: no person {files.label} in this mask, which has {there}, nor in the masks of any of the {frames} "
        f"training frames. Give dataset.person the value that the masks have, or check dataset.masks."
    )
