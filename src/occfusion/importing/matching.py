"""Which of another tool's rows belongs to which frame of a clip."""

from __future__ import annotations

import re
from collections.abc import Sequence

from occfusion.errors import DataError
from occfusion.footage.clip import Clip, Shot


def places_of(names: Sequence[str], clip: Clip, shot: Shot, where: str) -> list[int | None]:
    """Returns for each picture of a shot the place in `names` of what belongs to it; None where nothing does.

    By the names of a folder's pictures; else in order, where there are as many as the clip or the shot has frames;
    else by the last number in each name, counted from 0.

    Args:
        names: of a tool's rows, without suffix, in order of time.
        clip: that the shot is of.
        shot: the chosen pictures.
        where: the file, for messages.

    Raises:
        DataError: they belong to other pictures.
    """
    if clip.pictures:
        by_name = {name: place for place, name in enumerate(names)}
        found = [by_name.get(clip.pictures[number].stem) for number in shot.numbers]
        if any(place is not None for place in found):
            return found
    if len(names) == clip.frames and max(shot.numbers) < clip.frames:
        return list(shot.numbers)
    if len(names) == len(shot):
        return list(range(len(shot)))
    counted = {
        number: place for place, name in enumerate(names) if (number := _last_number(name)) is not None
    }
    if len(counted) == len(names) and counted and max(counted) < max(clip.frames, max(shot.numbers) + 1):
        found = [counted.get(number) for number in shot.numbers]
        if any(place is not None for place in found):
            return found
    raise DataError(
        f"{where}: has rows for {len(names)} frames ({_some(names)}); the clip has {clip.frames}, of which "
        f"{len(shot)} are used. Give one for each frame, or names that end in the frame's number, from 0."
    )


def natural(name: str) -> list[tuple[int, str]]:
    """Returns the key by which names are ordered as people count: 2 before 10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name) if part]


def _last_number(name: str) -> int | None:
    numbers = re.findall(r"\d+", name)
    return int(numbers[-1]) if numbers else None


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) < 3 else f"{names[0]} to {names[-1]}"
