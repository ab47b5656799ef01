"""What an import works on: pictures, masks, key points and a camera, each found here or given by another tool."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.footage.camera import Intrinsics, find_intrinsics
from occfusion.footage.clip import SIDE, Clip, Shot, cuts, open_clip, read_clip
from occfusion.footage.landmarks import KeyPoints
from occfusion.footage.mattes import person_masks
from occfusion.footage.people import follow

Mask = NDArray[np.bool_]
Advance = Callable[[str], None]

FEWEST = 8
"""An avatar needs more than a few moments."""


@dataclass(frozen=True)
class Choice:
    """Which frames of a clip are taken, and of whom.

    Attributes:
        every: each so-manyth frame; None for at most 30 a second.
        frames: at most so many, evenly spread.
        start: first frame.
        stop: frame after the last; None for the end.
        side: longer side of the pictures, pixels.
        rotate: degrees by which pictures are turned clockwise: 0, 90, 180 or 270.
        person: which of several, from 1.
        focal: in pixels of the file; None for EXIF's or a guess.
    """

    every: int | None = None
    frames: int | None = None
    start: int = 0
    stop: int | None = None
    side: int = SIDE
    rotate: int = 0
    person: int | None = None
    focal: float | None = None


@dataclass
class Sources:
    """Everything that a fit starts from.

    Attributes:
        clip: where it comes from.
        shot: the pictures.
        points: key points, one row a picture.
        masks: of the visible person, `[H, W]` each.
        intrinsics: the camera.
        hidden: where something stands before the person; None where nothing is known.
        notes: what a user should know, in sentences.
    """

    clip: Clip
    shot: Shot
    points: KeyPoints
    masks: list[Mask]
    intrinsics: Intrinsics
    hidden: list[Mask] | None = None
    notes: list[str] = field(default_factory=list)


def read_pictures(path: Path | str, choice: Choice) -> tuple[Clip, Shot]:
    """Returns the chosen pictures of a clip, which must be one shot.

    Raises:
        DataError: the clip cannot be used; the frame is named.
    """
    clip = open_clip(path)
    shot = read_clip(
        clip, every=choice.every, frames=choice.frames, start=choice.start, stop=choice.stop, side=choice.side
    )
    if choice.rotate:
        code = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}[
            choice.rotate
        ]
        shot.pictures[:] = [
            np.asarray(cv2.rotate(picture, code), dtype=np.uint8) for picture in shot.pictures
        ]
    if len(shot) < FEWEST:
        raise DataError(f"{clip.path}: {len(shot)} frames are chosen; an avatar needs {FEWEST} and more.")
    if found := cuts(shot.pictures):
        places = [0, *found, len(shot)]
        stretches = [(shot.numbers[a], shot.numbers[b - 1] + 1) for a, b in pairwise(places)]
        longest = max(stretches, key=lambda s: s[1] - s[0])
        at = ", ".join(str(shot.numbers[k]) for k in found[:6])
        raise DataError(
            f"{clip.path}: new shots begin at frame {at}; one shot is one fit. The longest: "
            f"--start {longest[0]} --stop {longest[1]}."
        )
    if np.abs(shot.pictures[0].astype(np.int16) - shot.pictures[-1]).max() < 3 and _still(shot.pictures):
        raise DataError(f"{clip.path}: all frames show the same still picture; nothing moves.")
    return clip, shot


def _still(pictures: Sequence[NDArray[np.uint8]]) -> bool:
    first = pictures[0].astype(np.int16)
    return all(np.abs(picture - first).max() < 3 for picture in pictures)


def gather(path: Path | str, choice: Choice, *, advance: Advance = lambda _: None) -> Sources:
    """Returns what the embedded models see in a clip.

    Raises:
        ConfigError: a choice is out of range, or the models cannot run.
        DataError: the clip cannot be used.
    """
    clip, shot = read_pictures(path, choice)
    intrinsics = find_intrinsics(
        shot.size, shot.scale, choice.focal, clip.pictures[0] if clip.pictures else None
    )
    track = follow(shot.pictures, shot.numbers, person=choice.person, advance=lambda: advance("person"))
    seen = np.flatnonzero([sighting is not None for sighting in track.sightings])
    first, last = int(seen[0]), int(seen[-1]) + 1
    part = Shot(
        shot.pictures[first:last], shot.numbers[first:last], shot.seconds[first:last], shot.scale, shot.notes
    )
    track.sightings[:] = track.sightings[first:last]
    advance("masks")
    masks = person_masks(part.pictures, track.sightings)
    return Sources(clip, part, track.keypoints(), masks, intrinsics, None, [*shot.notes, *track.notes])
