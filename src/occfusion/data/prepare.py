"""From a reader and settings to what is trained on: frames, cameras, occlusion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from occfusion.data.checking import survey
from occfusion.data.occlusion import OcclusionSettings, plan
from occfusion.data.sampling import spread
from occfusion.data.scene import PictureFiles, Scene
from occfusion.data.silhouette import Hidden
from occfusion.errors import ConfigError, DataError
from occfusion.files.images import image_size, read_numbers

T = TypeVar("T")

MIN_SIZE, MAX_SIZE = 16, 4096
"""Permitted `dataset.image_size`: below, nothing of a person is left; above, memory is."""

TRAIN_FRAMES = 100
"""The paper trains on 100 frames of each ZJU-MoCap sequence, 0 to 495."""

MAX_STEP = 5
TEST_EVERY = 6
"""Held-out moments are every sixth training frame: 0 to 480 by 30 on ZJU-MoCap."""


def paper_step(num_frames: int) -> int:
    """Returns the distance of the paper's training frames, 5, less for sequences shorter than 500."""
    return min(max(num_frames // TRAIN_FRAMES, 1), MAX_STEP)


def train_range(spec: Sequence[int | None] | None, num_frames: int) -> tuple[int, ...]:
    """Returns the training frames: `spec` as `[start, stop, step]`, or the paper's when None."""
    step = paper_step(num_frames)
    return frame_range(spec, (0, TRAIN_FRAMES * step, step), num_frames, "dataset.train_frames")


def held_out_range(spec: Sequence[int | None] | None, num_frames: int) -> tuple[int, ...]:
    """Returns the held-out frames: `spec` as `[start, stop, step]`, or the paper's when None."""
    step = paper_step(num_frames)
    return frame_range(spec, (0, TRAIN_FRAMES * step, TEST_EVERY * step), num_frames, "dataset.test_frames")


def frame_range(
    spec: Sequence[int | None] | None, default: tuple[int, int, int], num_frames: int, key: str
) -> tuple[int, ...]:
    """Returns the frames of `[start, stop, step]`, cut to those that exist; a null stop means the end.

    Raises:
        ConfigError: not three integers, a negative start, a step below 1, or no frame left.
    """
    if spec is None:
        start, stop, step = default
    else:
        parts = list(spec) if isinstance(spec, Sequence) and not isinstance(spec, str) else None
        if parts is None or len(parts) != 3:
            raise ConfigError(f"{key}={spec!r}: give [start, stop, step], for example [0, 500, 5], or null.")
        if parts[1] is None:
            parts[1] = num_frames
        if any(isinstance(p, bool) or not isinstance(p, int) for p in parts):
            raise ConfigError(f"{key}={spec!r}: start, stop and step must be whole numbers.")
        start, stop, step = (int(p) for p in parts if p is not None)
    if start < 0 or step < 1:
        raise ConfigError(f"{key}={spec!r}: start must be at least 0 and step at least 1.")
    frames = tuple(range(start, min(stop, num_frames), step))
    if not frames:
        raise ConfigError(f"{key}={spec!r}: selects nothing; the scene has the frames 0..{num_frames - 1}.")
    return frames


def held_out_cameras(spec: Sequence[int] | None, train_camera: int, count: int) -> tuple[int, ...]:
    """Returns the test cameras: `spec`, or all but the training camera when None.

    Raises:
        ConfigError: a camera does not exist or is named twice.
    """
    if isinstance(train_camera, bool) or not isinstance(train_camera, int) or not 0 <= train_camera < count:
        raise ConfigError(
            f"dataset.train_camera={train_camera!r}: the scene has the cameras 0..{count - 1}. Choose one of them; "
            "where it is not set, dataset.protocol chooses."
        )
    if spec is None:
        return tuple(camera for camera in range(count) if camera != train_camera)
    if isinstance(spec, str) or not isinstance(spec, Sequence):
        raise ConfigError(
            f"dataset.test_cameras={spec!r}: give a list of indices, or null for all the others."
        )
    if any(isinstance(c, bool) or not isinstance(c, int) or not 0 <= c < count for c in spec):
        raise ConfigError(f"dataset.test_cameras={list(spec)!r}: the scene has the cameras 0..{count - 1}.")
    if len(set(spec)) != len(spec):
        raise ConfigError(f"dataset.test_cameras={list(spec)!r}: a camera is named twice.")
    return tuple(spec)


@dataclass(frozen=True)
class Selection:
    """What the user asks for; None means the paper's protocol.

    Attributes:
        train_camera: index of the camera trained on.
        test_cameras: indices of the held-out cameras.
        train_frames: `[start, stop, step]`.
        test_frames: `[start, stop, step]`.
        max_train_frames: of more training frames so many are taken, evenly spread.
    """

    train_camera: int
    test_cameras: Sequence[int] | None
    train_frames: Sequence[int | None] | None
    test_frames: Sequence[int | None] | None
    max_train_frames: int | None = None


@dataclass(frozen=True)
class Prepared:
    """What is there and was selected, and what is hidden.

    Attributes:
        scene: the reader.
        train: training frames that show a person.
        people: what their masks show.
        hidden: the simulated occlusion of each, in pixels of the stored picture.
        left_out: training frames whose mask is empty.
        offered: how many training frames were asked for, before `max_train_frames` took some of them.
        sequence: those that it took, of which steps may see only some.
        test: held-out frames.
        camera: the camera trained on.
        cameras: held-out cameras.
    """

    scene: Scene
    train: tuple[int, ...]
    people: tuple[survey.Person, ...]
    hidden: tuple[Hidden | None, ...]
    left_out: tuple[int, ...]
    offered: int
    sequence: tuple[int, ...]
    test: tuple[int, ...]
    camera: int
    cameras: tuple[int, ...]

    @property
    def train_views(self) -> tuple[tuple[int, int], ...]:
        """The training `(frame, camera)`."""
        return tuple((frame, self.camera) for frame in self.train)

    @property
    def test_views(self) -> tuple[tuple[int, int], ...]:
        """The held-out `(frame, camera)`, camera by camera, without those that are trained on.

        Where all of them are, the user has asked for just that.
        """
        trained = set(self.train_views)
        asked = tuple((frame, camera) for camera in self.cameras for frame in self.test)
        return tuple(view for view in asked if view not in trained) or asked

    @property
    def unknown(self) -> tuple[bool, ...]:
        """Whether real things or other people may hide parts of the person that no file shows, by frame."""
        anything = self.scene.files(self.train[0], self.camera).truth_unknown
        return tuple(anything or person.crowded for person in self.people)

    def visible_shares(self) -> list[float]:
        """Returns which share of the known whole person each training frame shows."""
        return [p.visible_share(box) for p, box in zip(self.people, self.hidden, strict=True)]


def prepare(
    scene: Scene, selection: Selection, occlusion: OcclusionSettings, most_seen: int | None = None
) -> Prepared:
    """Returns what the selection means for this scene; reads the masks of the training frames.

    Args:
        scene: the reader.
        selection: what the user asks for.
        occlusion: what is simulated.
        most_seen: of more training frames so many are taken, evenly spread; steps see no others. None: all.

    Raises:
        ConfigError: a frame range or camera that the scene has not.
        DataError: a training file is missing, no training frame shows a person, or all of it is hidden.
    """
    camera = selection.train_camera
    cameras = held_out_cameras(selection.test_cameras, camera, len(scene.cameras))
    offered = train_range(selection.train_frames, scene.num_frames)
    sequence = _thinned(offered, selection.max_train_frames)
    wanted = _thinned(sequence, most_seen)
    held_out = held_out_range(selection.test_frames, scene.num_frames)
    if selection.test_frames is None:
        held_out = _shown(scene, cameras, held_out, sequence)
    survey.require_files(scene, ((frame, camera) for frame in wanted))
    found = survey.scan_people(scene, wanted, camera)
    _check_sizes(scene, wanted, camera, found)
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
        offered=len(offered),
        sequence=sequence,
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


def _thinned(frames: tuple[int, ...], most: int | None) -> tuple[int, ...]:
    return frames if most is None else tuple(frames[k] for k in spread(len(frames), most))


def _check_sizes(scene: Scene, frames: Sequence[int], camera: int, people: Sequence[survey.Person]) -> None:
    """Refuses training masks that are not of their picture's size, before anything is planned by them."""
    for frame, person in zip(frames, people, strict=True):
        files = scene.files(frame, camera)
        size, wanted = (person.seen.width, person.seen.height), image_size(files.rgb)
        if size != wanted:
            raise DataError(
                f"{files.masks[0]}: {size[0]} x {size[1]} pixels, but its picture {files.rgb.name} has {wanted[0]} x "
                f"{wanted[1]}; pictures and masks must have one size."
            )


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


def find_protocol(protocols: Mapping[str, T], name: str, dataset: str) -> T:
    """Returns the protocol of a name.

    Args:
        protocols: those of a data set.
        name: of the one that is wanted.
        dataset: for messages.

    Raises:
        ConfigError: there is none of that name.
    """
    if name not in protocols:
        raise ConfigError(f"dataset.protocol={name!r}: for {dataset} choose one of {', '.join(protocols)}.")
    return protocols[name]
