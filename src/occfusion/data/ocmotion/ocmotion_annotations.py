"""The pickles of OcMotion as released: which sequences they have, and the rows of one of them.

Upstream reads lists of sequences, of cameras, of frames. Lists of frames without cameras around them, as its authors'
other data sets have, are taken for cameras; those of one sequence are put together.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from occfusion.data.checking import checks
from occfusion.data.folder_contents import MAX_DIGITS, inside, need
from occfusion.errors import ConfigError, DataError
from occfusion.files.thinned import Thin, load_thinned
from occfusion.files.unpickle import load_pickle

PATH, SIZE = "img_path", "h_w"
"""Keys of a row that are no people."""

SAME_PLACE = 0.3
"""Metres from frame to frame, and from camera to camera, within which two people may be one."""

Person = Mapping[str, Any]

_LAST_NUMBER = re.compile(r"(\d+)\D*\Z")


class Shot(NamedTuple):
    """One annotated picture.

    Attributes:
        place: in the list of its camera.
        path: of the picture, below the data set's folder, with forward slashes.
        size: height and width as they are declared; None where they are not.
        people: by number, those who are annotated in it; none is normal.
    """

    place: int
    path: PurePosixPath
    size: Any
    people: dict[int, Person]


class FrameSets(NamedTuple):
    """Pictures of the same moments.

    Attributes:
        shots: of each moment the picture of each camera.
        lost: moments that not every camera has.
        by_number: pictures were paired by the numbers in their names; else by their place in the lists.
    """

    shots: list[tuple[Shot, ...]]
    lost: int
    by_number: bool


def last_number(name: str) -> int | None:
    """Returns the last number in a name, None where there is none or it is too long."""
    found = _LAST_NUMBER.search(name)
    return int(found[1]) if found and len(found[1]) <= MAX_DIGITS else None


def person_number(key: object) -> int | None:
    """Returns the number of a person's key, None for other keys; `0`, `'0'` and `'00'` are one person."""
    if isinstance(key, int) and not isinstance(key, bool):
        return key if key >= 0 else None
    text = str(key) if isinstance(key, str) else ""
    return int(text) if text.isdecimal() and len(text) <= MAX_DIGITS else None


def people_of(row: Mapping[Any, Any], where: str) -> dict[int, Person]:
    """Returns the people of a row by number.

    Raises:
        DataError: two keys are the same number.
    """
    found: dict[int, Person] = {}
    for key, value in row.items():
        number = person_number(key)
        if number is None or not isinstance(value, Mapping) or not value:
            continue
        if number in found:
            raise DataError(
                f"{where}: has person {number} twice, the second time as {key!r}; keep one of them."
            )
        found[number] = value
    return found


def read_shots(rows: Sequence[Mapping[Any, Any]], where: str) -> list[Shot]:
    """Returns the pictures of one camera.

    Args:
        rows: the camera's list.
        where: what messages call it.

    Raises:
        DataError: a row has no path, or one that leads out of the folder, or a person twice.
    """
    shots = []
    for place, row in enumerate(rows):
        at = f"{where}, frame {place}"
        path = PurePosixPath(inside(need(row, PATH, at), at))
        shots.append(Shot(place, path, row.get(SIZE), people_of(row, at)))
    return shots


def pair(cameras: Sequence[Sequence[Shot]]) -> FrameSets:
    """Returns which pictures are of one moment: those with the same number in their names, in its order.

    Where a name has no number, or a camera has a number twice, the place in the lists is the moment.
    """
    numbers = [[last_number(shot.path.stem) for shot in shots] for shots in cameras]
    if all(None not in found and len(set(found)) == len(found) for found in numbers):
        by_number = [dict(zip(*both, strict=True)) for both in zip(numbers, cameras, strict=True)]
        known = set.intersection(*(set(found) for found in numbers))
        everything = set.union(*(set(found) for found in numbers))
        order = sorted(number for number in known if number is not None)
        return FrameSets(
            [tuple(camera[k] for camera in by_number) for k in order], len(everything - known), True
        )
    shots = list(zip(*cameras, strict=False))
    return FrameSets(shots, max(map(len, cameras)) - len(shots), False)


def count_people(cameras: Sequence[Sequence[Shot]]) -> Counter[int]:
    """Returns in how many pictures each person is annotated, by number."""
    return Counter(number for shots in cameras for shot in shots for number in shot.people)


def distance(a: Person, b: Person) -> float | None:
    """Returns the distance of two annotated people in metres, None where it cannot be told."""
    try:
        places = [checks.numbers(row["trans"], 3, "trans") for row in (a, b)]
    except (KeyError, DataError):
        return None
    return float(np.linalg.norm(places[0] - places[1]))


def successor(shots: list[Shot], person: int) -> tuple[int, Shot, float] | None:
    """Returns who appears where and when the wanted person ends: number, picture, distance in metres."""
    for before, after in pairwise(shots):
        if person not in before.people or person in after.people:
            continue
        for number in sorted(after.people.keys() - before.people.keys()):
            gap = distance(before.people[person], after.people[number])
            if gap is not None and gap < SAME_PLACE:
                return number, after, gap
    return None


def frame_sets_in_words(frame_sets: FrameSets, person: int, kept: int, place: str) -> str:
    """Returns how many moments are used and why the others are not."""
    total = len(frame_sets.shots) + frame_sets.lost
    text = f"{kept} of the {total} moments of {place}, "
    text += "paired by the numbers in their names" if frame_sets.by_number else "by their place in the lists"
    if frame_sets.lost:
        text += f"; {frame_sets.lost} left out that not every camera has"
    if absent := len(frame_sets.shots) - kept:
        lacking = [shots for shots in frame_sets.shots if any(person not in shot.people for shot in shots)]
        nobody = sum(not any(shot.people for shot in shots) for shots in lacking)
        everywhere = " in every camera" if len(frame_sets.shots[0]) > 1 else ""
        text += (
            f"; {absent} left out that do not show person {person}{everywhere} ({nobody} of them show nobody)"
        )
    return text


_CAMERA = re.compile(r"(.+)_(\d{1,3})\Z")
_CLIP = re.compile(r"(.+?)_(\d{1,3})_\d{1,3}\Z")


class Found(NamedTuple):
    """A sequence in the annotations.

    Attributes:
        file: the annotations.
        number: its place in them.
        name: of the sequence.
        cameras: the rows of each camera that is read.
        is_flat: the file has lists of frames, without a level of cameras.
        unread: folders of the sequence's other cameras.
    """

    file: Path
    number: int
    name: str
    cameras: list[list[Mapping[Any, Any]]]
    is_flat: bool
    unread: tuple[str, ...] = ()


def sequence_name(path: object) -> str:
    """Returns the name of a picture's sequence: the folder above its camera's; empty where the path has none."""
    parts = _posix(path).parts
    return parts[-3] if len(parts) >= 3 else ""


def sequence_names(folder: Path) -> list[str]:
    """Returns the names of all sequences in the annotations of a folder, in order."""
    return [found.name for file in annotation_files(folder) for found in _all(file, set())]


def _posix(path: object) -> PurePosixPath:
    return PurePosixPath(str(path).replace("\\", "/"))


def annotation_files(folder: Path) -> list[Path]:
    """Returns the annotations that a folder has."""
    return [file for name in ("train.pkl", "test.pkl") if (file := folder / "annot" / name).is_file()]


def _all(file: Path, wanted: set[str]) -> list[Found]:
    """Returns all sequences of a file; frames of those not wanted have nothing but a path."""
    return _grouped(load_thinned(file, _dropping_all_but(wanted)), file)


def _dropping_all_but(wanted: set[str]) -> Thin:
    """Returns what drops the frames of all other sequences; where the path names none, the frame is kept."""
    stands: dict[PurePosixPath, dict[str, str]] = {}

    def thin(frame: dict[Any, Any]) -> object | None:
        path = frame.get(PATH)
        if not isinstance(path, str) or sequence_name(path) in ("", *wanted):
            return None
        return stands.setdefault(_posix(path).parent, {PATH: path})  # one for each folder of pictures

    return thin


def find_sequence(folder: Path, sequence: str) -> Found:
    """Returns a sequence, or one camera of it.

    Args:
        folder: the folder that holds `annot/`.
        sequence: its name; with `_02` behind it, its camera 02 alone.

    Raises:
        ConfigError: no such sequence or camera.
        DataError: no annotations, or they are damaged.
    """
    camera, clip = _CAMERA.match(sequence), _CLIP.match(sequence)
    wanted = {sequence, *(match[1] for match in (camera, clip) if match)}
    names: list[str] = []
    files = annotation_files(folder)
    for file in files:
        by_name = {found.name: found for found in _all(file, wanted)}
        if sequence in by_name:
            return _complete(by_name[sequence])
        if camera and camera[1] in by_name:
            return _one_camera(_complete(by_name[camera[1]]), int(camera[2]), sequence)
        if clip and clip[1] in by_name:
            raise ConfigError(
                f"dataset.scene={sequence!r}: {sequence} is a clip that Wild2Avatar cut from camera {clip[2]} of "
                f"{clip[1]}, and {file} does not say where it begins. Set dataset.scene={clip[1]}_{clip[2]} and "
                "dataset.train_frames=[start, stop, 2]."
            )
        names += by_name
    if not names:
        lacks = "no sequence in its annotations" if files else "neither train.pkl nor test.pkl"
        raise DataError(f"{folder / 'annot'}: holds {lacks}.")
    raise ConfigError(
        f"dataset.scene={sequence!r}: the annotations in {folder / 'annot'} have {', '.join(names)[:400]}; one camera "
        f"alone is called as {names[0]}_02."
    )


def _complete(found: Found) -> Found:
    """Returns a sequence with all its frames."""
    if any(row.keys() == {PATH} for rows in found.cameras for row in rows):
        # pictures of one sequence lie in folders of several names: rare, and then everything is read
        everything = _grouped(load_pickle(found.file), found.file)
        return next(other for other in everything if other.number == found.number)
    return found


def _one_camera(found: Found, number: int, sequence: str) -> Found:
    """Returns a sequence with the camera of a number alone, by the name of its pictures' folder."""
    folders = [_posix(rows[0].get(PATH, "")).parent for rows in found.cameras]
    numbers = [last_number(folder.name) for folder in folders]
    if numbers.count(number) != 1:
        raise ConfigError(
            f"dataset.scene={sequence!r}: {found.file}, {found.name} has no camera {number}; its pictures lie in "
            f"{', '.join(map(str, folders))}."
        )
    chosen = numbers.index(number)
    unread = tuple(folder.name for k, folder in enumerate(folders) if k != chosen)
    return found._replace(cameras=[found.cameras[chosen]], unread=unread)


def _grouped(content: Any, file: Path) -> list[Found]:
    """Returns the sequences of a file, their nesting checked; empty lists are left out."""
    if not isinstance(content, (list, tuple)):
        raise DataError(f"{file}: holds a {type(content).__name__}, not a list of sequences.")
    found: dict[str, Found] = {}
    for number, entry in enumerate(content):
        if not isinstance(entry, (list, tuple)):
            raise DataError(f"{file}: sequence {number} is no list of cameras.")
        is_flat = bool(entry) and isinstance(entry[0], Mapping)
        cameras = [
            rows
            for c, rows in enumerate([entry] if is_flat else entry)
            if _checked_rows(rows, file, number, c)
        ]
        if not cameras:
            continue
        name = sequence_name(cameras[0][0].get(PATH, "")) or f"{file.stem}/{number}"
        if is_flat and name in found and found[name].is_flat:
            found[name] = found[name]._replace(cameras=[*found[name].cameras, *cameras])
        else:
            known = name if name not in found else f"{file.stem}/{number}"
            found[known] = Found(file, number, known, cameras, is_flat)
    return list(found.values())


def _checked_rows(rows: Any, file: Path, number: int, camera: int) -> bool:
    """Returns whether a camera has frames; raises DataError where it is no list of tables."""
    if not isinstance(rows, (list, tuple)):
        raise DataError(f"{file}: sequence {number}, camera {camera} is no list of frames.")
    for index, row in enumerate(rows):
        if not isinstance(row, Mapping):
            raise DataError(f"{file}: sequence {number}, camera {camera}, frame {index} is no table.")
    return bool(rows)
