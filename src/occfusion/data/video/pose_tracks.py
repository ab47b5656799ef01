"""Which of a folder's pose files are read, and which pictures each of them covers.

InstantAvatar leaves several answers in one folder:

| file | what it is | covers |
|---|---|---|
| `poses.npz` | the first estimate, ROMP's or PeopleSnapshot's | every picture |
| `poses_optimized.npz` | fitted to key points; its own program reads this and never the first | every picture |
| `poses/anim_nerf_train.npz`, `_test`, `_val` | refined, PeopleSnapshot | a `[start, stop, step]` of its settings |
| `poses/train.npz`, `test`, `val` | refined with an avatar | the same |

The order in which they are looked for is that of its program. Its settings are not in the folder, so which
pictures a refined track covers is found out: as many rows as pictures; or the range of its settings for a subject
of this name, where the number of rows is right; or the one range from the first picture on whose poses are near
those of `poses.npz`, where all others are far. Nothing else is assumed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.data.scene import Array
from occfusion.data.video.pose_table import Motion, load_motion
from occfusion.data.video.video_protocols import INSTANT_AVATAR
from occfusion.errors import ConfigError, DataError

MIN_ROWS = 8
"""A shorter track could lie anywhere; it also bounds the number of ranges to compare."""

NEAR, FAR = 1.5, 2.0
"""A range agrees when its distance is at most `NEAR` times the smallest; others must have `FAR` times as much."""

_COMPARED_ROWS = 64
_TINY = 1e-9


def distances(track: Motion, every: Motion) -> Array:
    """Returns the mean squared distance between the joints' rotations, `[rows, pictures]`.

    Args:
        track: the poses whose pictures are looked for.
        every: poses of all pictures.
    """
    a, b = _rotations(track), _rotations(every)
    squared = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None] - 2 * a @ b.T
    return np.asarray(np.maximum(squared, 0.0) / a.shape[1])


def _nearest(table: Array) -> dict[int, float]:
    """Returns the smallest mean distance of each step, of a table as `distances` gives it; empty for a short track."""
    rows, pictures = table.shape
    if rows < MIN_ROWS or not np.isfinite(table).all():
        return {}
    compared, found = _compared(rows), {}
    for step in possible_steps(rows, pictures):
        starts = np.arange(pictures - step * (rows - 1))[:, None]
        found[step] = float(table[compared, starts + step * compared].mean(axis=1).min())
    return found


def _agrees(table: Array, by_step: Mapping[int, float], asked: range) -> bool:
    """Whether no other range is clearly nearer than one."""
    if not by_step:
        return True
    rows = _compared(len(table))
    mean = float(table[rows, asked.start + asked.step * rows].mean())
    return mean <= NEAR * min(by_step.values()) + _TINY


def _from_picture_0(table: Array) -> range | None:
    """Returns the range from picture 0 on, where it is the one near and all other steps are far; else None."""
    by_step = _nearest(table)
    if not by_step:
        return None
    step = min(by_step, key=lambda k: by_step[k])
    asked = range(0, step * (len(table) - 1) + 1, step)
    alone = all(far >= FAR * by_step[step] + _TINY for other, far in by_step.items() if other != step)
    return asked if alone and _agrees(table, by_step, asked) else None


def possible_steps(rows: int, pictures: int) -> range:
    """Returns the steps with which `rows` rows fit into `pictures` pictures."""
    return range(1, (pictures - 1) // (rows - 1) + 1) if rows > 1 else range(1, 2)


def _compared(rows: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, rows - 1, _COMPARED_ROWS).round()).astype(np.int64)


def _rotations(motion: Motion) -> Array:
    turns = np.concatenate([motion.global_orient, motion.body_pose], axis=1).reshape(-1, 3)
    matrices = [cv2.Rodrigues(turn)[0] for turn in turns]
    return np.asarray(matrices, dtype=np.float64).reshape(len(motion), -1)


FIRST, OPTIMIZED = "poses.npz", "poses_optimized.npz"
SPLITS = ("train", "test", "val")

_MOST_CHOICES = 6


@dataclass(frozen=True)
class Track:
    """A pose file and what it covers.

    Attributes:
        name: the file, relative to the sequence's folder.
        motion: its poses.
        pictures: the picture of each row, by its place in the folder, from 0.
        known_by: how that was found out, in words.
    """

    name: str
    motion: Motion
    pictures: range
    known_by: str


@dataclass(frozen=True)
class Tracks:
    """What was read.

    Attributes:
        read: the tracks, the first of which wins where two cover a picture.
        others: pose files that are there and were not read, each with the reason or how to ask for it.
    """

    read: tuple[Track, ...]
    others: tuple[str, ...]

    def rows(self) -> dict[int, tuple[Track, int]]:
        """Returns (track, row) of every covered picture, in order of the pictures."""
        found: dict[int, tuple[Track, int]] = {}
        for track in self.read:
            for row, picture in enumerate(track.pictures):
                found.setdefault(picture, (track, row))
        return dict(sorted(found.items()))


def _from_first(track: Motion, first: Path, pictures: int) -> Array | None:
    """Returns the distances from a track's rows to the first estimate of all pictures, None where there is none."""
    if not first.is_file():
        return None
    try:
        every = load_motion(first)
    except DataError:  # it is not what is read: without it, the range has to be given
        return None
    return distances(track, every) if len(every) == pictures else None


def pose_files(folder: Path) -> list[str]:
    """Returns the pose files that a folder has under the names above, relative to it."""
    names = [FIRST, OPTIMIZED]
    names += [f"poses/{prefix}{split}.npz" for split in SPLITS for prefix in ("anim_nerf_", "")]
    return [name for name in names if (folder / name).is_file()]


def open_tracks(
    folder: Path, pictures: int, chosen: str | None = None, ranges: Sequence[object] | None = None
) -> Tracks:
    """Returns the pose files to read and what they cover.

    Args:
        folder: the sequence's folder.
        pictures: how many pictures it has.
        chosen: one file, relative to the folder; None for what InstantAvatar's program reads.
        ranges: `[start, stop, step]` of the pictures that the file covers, or one of these for each file.

    Raises:
        ConfigError: `chosen` is not there, or `ranges` do not fit.
        DataError: no pose file, a damaged one, or it is not known which pictures it covers.
    """
    there = pose_files(folder)
    if chosen is not None and not (folder / str(chosen)).is_file():
        raise ConfigError(
            f"dataset.poses={chosen!r}: {folder} has no such file; it has {', '.join(there) or 'no pose file'}."
        )
    wanted = [str(chosen)] if chosen is not None else _by_default(there)
    given = _given(ranges, wanted, pictures)
    read: list[Track] = []
    others = [f"{name} (dataset.poses={name} reads it)" for name in there if name not in wanted]
    for name, asked in zip(wanted, given, strict=True):
        motion = load_motion(folder / name)
        try:
            covered, known_by = _covered(motion, name, pictures, asked, folder)
        except DataError as error:
            if not read:  # the first file is the scene; those of held-out pictures only add to it
                raise
            others.append(f"{name}, because {error}")
            continue
        read.append(Track(name, motion, covered, known_by))
    return Tracks(tuple(read), tuple(others))


def _by_default(there: Sequence[str]) -> list[str]:
    splits = [
        next((name for name in (f"poses/anim_nerf_{split}.npz", f"poses/{split}.npz") if name in there), None)
        for split in ("train", "test")
    ]
    if splits[0] is not None:
        return [name for name in splits if name is not None]
    return [OPTIMIZED if OPTIMIZED in there else FIRST]


def _given(ranges: Sequence[object] | None, wanted: Sequence[str], pictures: int) -> list[range | None]:
    """Returns the range that the user gives for each file, None where there is none."""
    if ranges is None:
        return [None] * len(wanted)
    if isinstance(ranges, str) or not isinstance(ranges, Sequence):
        raise ConfigError(f"dataset.track_frames={ranges!r}: give [start, stop, step], or null.")
    each = list(ranges) if ranges and all(_is_list(part) for part in ranges) else [ranges]
    if len(each) > len(wanted):
        raise ConfigError(
            f"dataset.track_frames={ranges!r}: {len(each)} ranges for {len(wanted)} pose files ({', '.join(wanted)})."
        )
    found: list[range | None] = [_range(part, ranges, pictures) for part in each]
    return found + [None] * (len(wanted) - len(each))


def _is_list(value: object) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _range(part: object, ranges: object, pictures: int) -> range:
    numbers = list(part) if _is_list(part) else []  # type: ignore[call-overload]
    if len(numbers) == 3 and numbers[1] is None:
        numbers[1] = pictures
    if len(numbers) != 3 or any(type(n) is not int for n in numbers) or numbers[0] < 0 or numbers[2] < 1:
        raise ConfigError(
            f"dataset.track_frames={ranges!r}: give [start, stop, step] as whole numbers, the stop left out, or one "
            "such list for each pose file."
        )
    return range(numbers[0], min(numbers[1], pictures), numbers[2])


def _covered(
    motion: Motion, name: str, pictures: int, asked: range | None, folder: Path
) -> tuple[range, str]:
    """Returns the pictures of a file's rows, and how that is known."""
    rows, where, subject = len(motion), str(motion.path), folder.name
    if asked is not None:
        if len(asked) != rows:
            raise ConfigError(
                f"dataset.track_frames: {len(asked)} of the {pictures} pictures are in "
                f"[{asked.start}, {asked.stop}, {asked.step}], but {where} has {rows} rows."
            )
        return asked, "dataset.track_frames"
    if rows == pictures:
        return range(pictures), "one row a picture"
    if rows > pictures:
        raise DataError(
            f"{where} has {rows} rows, but there are {pictures} pictures, one row for each; complete the pictures."
        )
    table = None if name == FIRST else _from_first(motion, folder / FIRST, pictures)
    known = _of_settings(name, subject)
    if known is not None and len(known) == rows and known[-1] < pictures:
        if table is not None and not _agrees(table, _nearest(table), known):
            raise DataError(
                _unknown(where, rows, pictures, "its poses are nearer to those of other pictures")
            )
        return known, f"InstantAvatar's settings for {subject}"
    found = None if table is None else _from_picture_0(table)
    if found is not None:
        return found, f"nearness to {FIRST}"
    raise DataError(_unknown(where, rows, pictures, "which ones cannot be told from the files"))


def _of_settings(name: str, subject: str) -> range | None:
    """Returns the pictures of InstantAvatar's settings for a subject and the split in a file's name."""
    split = Path(name).stem.removeprefix("anim_nerf_")
    ranges: Mapping[str, range] = {}
    if subject in INSTANT_AVATAR and name.startswith("poses/"):
        settings = INSTANT_AVATAR[subject]
        ranges = {"train": settings.train, "test": settings.test, "val": settings.test[:1]}
    return ranges.get(split)


def _unknown(where: str, rows: int, pictures: int, reason: str) -> str:
    steps = possible_steps(rows, pictures)[::-1][:_MOST_CHOICES]
    shown = ", ".join(f"[0,{step * (rows - 1) + 1},{step}]" for step in steps)
    return (
        f"{where} has {rows} rows for {pictures} pictures, and {reason}. Say it with dataset.track_frames=[start, "
        f"stop, step], for example {shown}; or read another pose file with dataset.poses."
    )
