"""Which of another tool's rows belongs to which frame of a clip."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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


def coco_entries(content: Any, key: str, path: Path) -> list[tuple[str, Mapping[str, Any]]] | None:
    """Returns the entries of COCO's results or annotations, each with its frame's name; None where it is no such file.

    Args:
        content: of the file.
        key: that each entry must have.
        path: the file, for messages.

    Raises:
        DataError: an entry has no image, or not this key.
    """
    names = {}
    if isinstance(content, Mapping) and isinstance(content.get("annotations"), list):
        names = {image["id"]: Path(str(image["file_name"])).stem for image in content.get("images", [])}
        content = content["annotations"]
    elif not (
        isinstance(content, list) and content and isinstance(content[0], Mapping) and "image_id" in content[0]
    ):
        return None
    found = []
    for k, entry in enumerate(content):
        if not isinstance(entry, Mapping) or "image_id" not in entry or key not in entry:
            raise DataError(f"{path}, entry {k}: has no image_id or no {key}.")
        image = entry["image_id"]
        found.append((names.get(image, Path(image).stem if isinstance(image, str) else str(image)), entry))
    return found


def _last_number(name: str) -> int | None:
    numbers = re.findall(r"\d+", name)
    return int(numbers[-1]) if numbers else None


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) < 3 else f"{names[0]} to {names[-1]}"
