"""The rows of OcMotion's annotations as pictures with people in them, and which pictures are of one moment."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from occfusion.data import checks
from occfusion.data.annots import inside
from occfusion.data.listing import MAX_DIGITS
from occfusion.data.tables import need
from occfusion.errors import DataError

PATH, SIZE = "img_path", "h_w"
"""Keys of a row that are no people."""

SAME_VIEW = 1e-6
"""Extrinsics this near to each other are one camera, written in float32."""

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


class Moments(NamedTuple):
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


def pair(cameras: Sequence[Sequence[Shot]]) -> Moments:
    """Returns which pictures are of one moment: those with the same number in their names, in its order.

    Where a name has no number, or a camera has a number twice, the place in the lists is the moment.
    """
    numbers = [[last_number(shot.path.stem) for shot in shots] for shots in cameras]
    if all(None not in found and len(set(found)) == len(found) for found in numbers):
        by_number = [
            dict(zip(found, shots, strict=True)) for found, shots in zip(numbers, cameras, strict=True)
        ]
        known = set.intersection(*(set(found) for found in numbers))
        everything = set.union(*(set(found) for found in numbers))
        order = sorted(number for number in known if number is not None)
        return Moments(
            [tuple(camera[k] for camera in by_number) for k in order], len(everything - known), True
        )
    count = min(len(shots) for shots in cameras)
    most = max(len(shots) for shots in cameras)
    return Moments([tuple(shots[k] for shots in cameras) for k in range(count)], most - count, False)


def count_people(cameras: Sequence[Sequence[Shot]]) -> Counter[int]:
    """Returns in how many pictures each person is annotated, by number."""
    return Counter(number for shots in cameras for shot in shots for number in shot.people)


def camera_moves(views: Sequence[Any]) -> bool:
    """Returns whether extrinsics, checked before, `[3, 4]` or `[4, 4]`, are not the same in all frames."""
    numbers = np.stack([np.asarray(view, dtype=np.float64).reshape(-1)[:12] for view in views])
    return bool(np.ptp(numbers, axis=0).max() > SAME_VIEW)


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


def moments_in_words(moments: Moments, person: int, kept: int, place: str) -> str:
    """Returns how many moments are used and why the others are not."""
    total = len(moments.shots) + moments.lost
    text = f"{kept} of the {total} moments of {place}, "
    text += "paired by the numbers in their names" if moments.by_number else "by their place in the lists"
    if moments.lost:
        text += f"; {moments.lost} left out that not every camera has"
    if absent := len(moments.shots) - kept:
        lacking = [shots for shots in moments.shots if any(person not in shot.people for shot in shots)]
        nobody = sum(not any(shot.people for shot in shots) for shots in lacking)
        everywhere = " in every camera" if len(moments.shots[0]) > 1 else ""
        text += (
            f"; {absent} left out that do not show person {person}{everywhere} ({nobody} of them show nobody)"
        )
    return text
