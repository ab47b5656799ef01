"""What an import works on: pictures, masks, key points and a camera, each found here or given by another tool."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.footage.blazepose import ENLARGED, Landmarker, Region, Sighting
from occfusion.footage.camera import Intrinsics, find_intrinsics
from occfusion.footage.clip import SIDE, Clip, Shot, chosen, cuts, open_clip, read_clip
from occfusion.footage.identity import require_one_person
from occfusion.footage.landmarks import INDEX, KeyPoints
from occfusion.footage.lift import lifted
from occfusion.footage.mattes import person_masks
from occfusion.footage.people import follow
from occfusion.importing.cameras import read_intrinsics
from occfusion.importing.keypoints import camera_in, read_keypoints
from occfusion.importing.masks import read_masks

Mask = NDArray[np.bool_]
Advance = Callable[[str], None]

FEWEST = 8
"""An avatar needs more than a few moments."""
BLOCK, UNMOVED = 8, 12
"""Pixels, a side, whose mean colours are compared; levels of 255 by which they differ where nothing moves."""
AROUND = 0.3
"""Margin about a given mask, of its extent, within which its person's key points are looked for."""


@dataclass(frozen=True)
class Choice:
    """Which frames of a clip are taken, and of whom.

    Attributes:
        every: each so-manyth frame; None for at most 30 a second.
        frames: at most so many.
        start: first frame.
        stop: frame after the last; None for the end.
        side: longer side of the pictures, pixels.
        rotate: degrees by which pictures are turned clockwise: 0, 90, 180 or 270.
        person: which of several, from 1.
        focal: in pixels of the file; None for EXIF's or a guess.
        way: how the `frames` are chosen: `even`, `sharpest` or `unlike`.
    """

    every: int | None = None
    frames: int | None = None
    start: int = 0
    stop: int | None = None
    side: int = SIDE
    rotate: int = 0
    person: int | None = None
    focal: float | None = None
    way: str = "even"


@dataclass(frozen=True)
class Given:
    """What other tools found, each instead of what would be found here.

    Attributes:
        keypoints: file or folder, see `keypoints.py`.
        masks: of the visible person, see `masks.py`.
        occluder: masks of what stands before the person.
        camera: see `cameras.py`.
        masks_person: number of the person where masks number several.
    """

    keypoints: Path | None = None
    masks: Path | None = None
    occluder: Path | None = None
    camera: Path | None = None
    masks_person: int | None = None

    def beside(self, folder: Path, *, camera: bool) -> Given:
        """Returns this with masks, and a camera if one is wanted, of a data folder where nothing else was given."""
        masks, cameras = folder / "masks", folder / "cameras.npz"
        return replace(
            self,
            masks=self.masks or (masks if masks.is_dir() else None),
            camera=self.camera or (cameras if camera and cameras.is_file() else None),
        )


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

    @property
    def seconds(self) -> list[float]:
        """Time of each frame."""
        return clock(self.clip, self.shot)

    def at(self, places: Sequence[int]) -> Sources:
        """Returns some of the frames."""
        return replace(
            self, shot=self.shot.at(places), points=self.points.at(places), masks=[self.masks[k] for k in places],
            hidden=None if self.hidden is None else [self.hidden[k] for k in places],
        )  # fmt: skip


def clock(clip: Clip, shot: Shot) -> list[float]:
    """Returns the time of each picture, seconds; those of a folder are taken for a tenth of a second apart."""
    return [0.1 * second for second in shot.seconds] if clip.pictures else list(shot.seconds)


def read_pictures(path: Path | str, choice: Choice) -> tuple[Clip, Shot]:
    """Returns the chosen pictures of a clip, which must be one shot.

    Raises:
        DataError: the clip cannot be used; the frame is named.
    """
    clip = open_clip(path)
    frames = choice.frames if choice.way == "even" else None
    shot = read_clip(
        clip, every=choice.every, frames=frames, start=choice.start, stop=choice.stop, side=choice.side
    )
    if choice.rotate:
        turns = choice.rotate // 90
        shot.pictures[:] = [np.ascontiguousarray(np.rot90(picture, -turns)) for picture in shot.pictures]
    count = min(len(shot), choice.frames or len(shot))
    if count < FEWEST:
        raise DataError(f"{clip.path}: {count} frames are chosen; an avatar needs {FEWEST} and more.")
    if found := cuts(shot.pictures):
        places = [0, *found, len(shot)]
        stretches = [(shot.numbers[a], shot.numbers[b - 1] + 1) for a, b in pairwise(places)]
        longest = max(stretches, key=lambda s: s[1] - s[0])
        at = ", ".join(str(shot.numbers[k]) for k in found[:6])
        raise DataError(
            f"{clip.path}: new shots begin at frame {at}; one shot is one fit. The longest: "
            f"--start {longest[0]} --stop {longest[1]}."
        )
    if still(shot.pictures):
        raise DataError(f"{clip.path}: all frames show the same still picture; nothing moves.")
    if choice.frames is not None and frames is None:
        shot = shot.at(chosen(shot.pictures, choice.frames, choice.way))
    return clip, shot


def still(pictures: Sequence[NDArray[np.uint8]]) -> bool:
    """Whether pictures show the same but for what compression does to them."""

    def small(picture: NDArray[np.uint8]) -> NDArray[np.int16]:
        scale = 1 / BLOCK
        return np.asarray(
            cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.int16
        )

    first = small(pictures[0])
    # the last is most unlike where anything moves
    return all(np.abs(small(other) - first).max() < UNMOVED for other in reversed(pictures))


def gather(
    path: Path | str,
    choice: Choice,
    given: Given | None = None,
    *,
    trimmed: bool = True,
    advance: Advance = lambda _: None,
) -> Sources:
    """Returns what other tools gave about a clip, and of the rest what the embedded models see in it.

    Args:
        path: the clip.
        choice: which frames, and of whom.
        given: files of other tools.
        trimmed: leave out frames at both ends that do not show the person.
        advance: called at each step with the stage's name.

    Raises:
        ConfigError: a choice is out of range, or the models cannot run.
        DataError: the clip or a file cannot be used.
    """
    given = given or Given()
    clip, shot = read_pictures(path, choice)
    notes = list(shot.notes)
    intrinsics: Intrinsics | None = None
    if given.camera is not None:
        intrinsics, said = read_intrinsics(given.camera, shot)
        notes += said
    elif given.keypoints is not None and choice.focal is None:
        intrinsics = camera_in(given.keypoints, shot)
    if intrinsics is None:
        intrinsics = find_intrinsics(
            shot.size, shot.scale, choice.focal, clip.pictures[0] if clip.pictures else None
        )
    hidden = None if given.occluder is None else read_masks(given.occluder, clip, shot)
    masks = None if given.masks is None else read_masks(given.masks, clip, shot, given.masks_person)
    if given.keypoints is None:
        pictures = shot.pictures if masks is None else _alone(shot.pictures, masks)
        track = follow(pictures, shot.numbers, person=choice.person, advance=lambda: advance("person"))
        points, sightings = lifted(track.keypoints()), track.sightings
        notes += track.notes
    else:
        points = read_keypoints(given.keypoints, clip, shot, choice.person)
        notes.append(f"key points of {given.keypoints.name}.")
        sightings = [] if masks is not None else _looked_at(shot.pictures, points, advance)
    if masks is None:
        advance("masks")
        masks = person_masks(shot.pictures, sightings)
        require_one_person(shot.pictures, masks, shot.numbers, clock(clip, shot))
    elif given.masks is not None:
        notes.append(f"masks of {given.masks.name}.")
    if hidden is not None:
        masks = [mask & ~cover for mask, cover in zip(masks, hidden, strict=True)]
    sources = Sources(clip, shot, points, masks, intrinsics, hidden, notes)
    if trimmed:
        seen = np.flatnonzero(points.presence > 0)
        return sources.at(range(int(seen[0]), int(seen[-1]) + 1))
    return sources


def _alone(pictures: Sequence[NDArray[np.uint8]], masks: Sequence[Mask]) -> list[NDArray[np.uint8]]:
    """Returns pictures that are black but for the surroundings of the mask, so that nobody else is found."""
    out = []
    for picture, mask in zip(pictures, masks, strict=True):
        alone = np.zeros_like(picture)
        if mask.any():
            rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
            margin = AROUND * max(rows[-1] - rows[0], columns[-1] - columns[0])
            part = tuple(
                slice(max(0, int(span[0] - margin)), int(span[-1] + margin) + 1) for span in (rows, columns)
            )
            alone[part] = picture[part]
        out.append(alone)
    return out


def _looked_at(
    pictures: Sequence[NDArray[np.uint8]], points: KeyPoints, advance: Advance
) -> list[Sighting | None]:
    """Returns what the landmark model sees where the given key points are, for its mask."""
    landmarker, out = Landmarker(), []
    hips = [INDEX["left_hip"], INDEX["right_hip"]]
    for k, picture in enumerate(pictures):
        sure = points.confidence[k] > 0
        sighting = None
        if sure[hips].all():
            middle = points.pixels[k][hips].mean(axis=0)
            reach = float(np.linalg.norm(points.pixels[k][sure] - middle, axis=1).max())
            sighting = landmarker(picture, Region(middle[0], middle[1], 2 * ENLARGED * reach, 0.0))
        out.append(sighting)
        advance("masks")
    return out
