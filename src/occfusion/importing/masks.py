"""Masks of a person, or of what stands before them, that other tools made.

| form | written by |
|---|---|
| a folder of pictures: black and white, soft, or with an alpha channel | matting and painting programs |
| pictures whose values number people; or a folder for each of them | SAM 2 `tools/vos_inference.py` |
| a list of `segmentation`, or of RLEs | COCO's results; `masklet` of SA-V |
| a video, bright where the person is | mattes, as RobustVideoMatting's `pha.mp4` |
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.images import MAX_LABEL, read_mask, read_numbers
from occfusion.files.jsonfile import load_json
from occfusion.files.naming import natural
from occfusion.footage.clip import PICTURE_SUFFIXES, VIDEO_SUFFIXES, Clip, Shot, open_clip, read_clip
from occfusion.importing.matching import coco_entries, places_of

Mask = NDArray[np.bool_]

MOST_PIXELS = 64_000_000
"""Of a mask in a file of run lengths, which says its own size."""
FEW = 10
"""So many values besides 0 are no people, but the labels of a parser."""
_SOFT = 128
_CHOOSE = "say which person is meant: --masks-person NUMBER."


def read_masks(path: Path, clip: Clip, shot: Shot, person: int | None = None) -> list[Mask]:
    """Returns a mask for each picture of a shot, `[H, W]`, in its size; empty where the tool has none.

    Args:
        path: file or folder that a tool wrote.
        clip: that it was run on.
        shot: the chosen pictures.
        person: number of the wanted person where the masks number several; None for all of them.

    Raises:
        DataError: missing, damaged, of no known form, of another clip, or empty in all frames.
    """
    if not path.exists():
        raise DataError(f"{path}: no such file or folder.")
    suffix = path.suffix.lower()
    if path.is_dir():
        masks = _folder(path, clip, shot, person)
    elif suffix == ".json":
        masks = _runs(path, clip, shot, person)
    elif suffix in VIDEO_SUFFIXES:
        masks = _matte(path, shot)
    else:
        raise DataError(
            f"{path}: masks are a folder of pictures, a .json of run lengths, or a video of mattes."
        )
    width, height = shot.size
    out = []
    for number, mask in zip(shot.numbers, masks, strict=True):
        if mask is not None and abs(mask.shape[1] * height - mask.shape[0] * width) > 2 * max(mask.shape):
            raise DataError(
                f"{path}, frame {number}: the mask has {mask.shape[1]} x {mask.shape[0]} pixels, the picture "
                f"{width} x {height}: another shape."
            )
        out.append(np.zeros((height, width), bool) if mask is None else _fitted(mask, (width, height)))
    if not any(mask.any() for mask in out):
        raise DataError(f"{path}: all masks are empty" + ("." if person is None else f" of person {person}."))
    return out


def _fitted(mask: Mask, size: tuple[int, int]) -> Mask:
    if mask.shape[::-1] == size:
        return mask
    return np.asarray(cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA)) >= _SOFT


def _folder(folder: Path, clip: Clip, shot: Shot, person: int | None) -> list[Mask | None]:
    files = sorted(
        (p for p in folder.iterdir() if p.suffix.lower() in (*PICTURE_SUFFIXES, ".npy")),
        key=lambda p: natural(p.stem),
    )
    if files:
        places = places_of([file.stem for file in files], clip, shot, str(folder))
        if person is None and files[0].suffix.lower() == ".png":
            _require_one(files[0])
        return [None if place is None else _picture(files[place], person) for place in places]
    people = sorted((p for p in folder.iterdir() if p.is_dir()), key=lambda p: natural(p.name))
    if person is not None:
        people = [p for p in people if p.name.isdigit() and int(p.name) == person]
    if not people:
        raise DataError(f"{folder}: holds no pictures" + ("." if person is None else f" of person {person}."))
    if len(people) > 1:
        raise DataError(f"{folder}: has masks of {', '.join(p.name for p in people)}; {_CHOOSE}")
    return _folder(people[0], clip, shot, None)


def _require_one(path: Path) -> None:
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if raw is None or (raw.ndim == 3 and raw.shape[2] == 4):
        return
    try:
        values = np.unique(read_numbers(path))
    except DataError:
        return  # colours, which number nobody
    if 1 < (values > 0).sum() < FEW and values.max() <= MAX_LABEL:
        raise DataError(f"{path}: has the numbers {', '.join(map(str, values[values > 0]))}; {_CHOOSE}")


def _picture(path: Path, person: int | None) -> Mask:
    if person is not None:
        return np.asarray(read_numbers(path) == person)
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.suffix.lower() != ".npy" else None
    if raw is not None and raw.ndim == 3 and raw.shape[2] == 4 and raw[..., 3].min() < raw[..., 3].max():
        return np.asarray(raw[..., 3] > (127 if raw.dtype == np.uint8 else 32767))
    return read_mask(path)


def _matte(path: Path, shot: Shot) -> list[Mask | None]:
    numbers = shot.numbers
    matte = read_clip(open_clip(path), every=1, start=numbers[0], stop=numbers[-1] + 1, side=max(shot.size))
    rows = dict(zip(matte.numbers, matte.pictures, strict=True))
    return [None if k not in rows else np.asarray(rows[k].max(axis=2) >= _SOFT) for k in numbers]


def _runs(path: Path, clip: Clip, shot: Shot, person: int | None) -> list[Mask | None]:
    """Returns the masks of COCO's results, of SA-V's masklets, or of a list of run lengths."""
    content = load_json(path)
    rows: dict[str, list[Any]] = {}
    if isinstance(content, Mapping) and isinstance(content.get("masklet"), list):
        for k, objects in enumerate(content["masklet"]):
            if person is None and len(objects) > 1:
                raise DataError(f"{path}: has {len(objects)} objects, numbered from 1; {_CHOOSE}")
            rows[str(k)] = list(objects) if person is None else list(objects[person - 1 : person])
    elif (entries := coco_entries(content, "segmentation", path)) is not None:
        for name, entry in entries:
            kept = rows.setdefault(name, [])
            if person is None or entry.get("track_id", entry.get("instance_id")) in (None, person):
                kept.append(entry["segmentation"])
    elif isinstance(content, list):
        rows = {str(k): row if isinstance(row, list) else [row] for k, row in enumerate(content)}
    if not rows:
        raise DataError(f"{path}: has no masklet, no annotations, and is no list of run lengths.")
    names = sorted(rows, key=natural)
    found = []
    for number, place in zip(shot.numbers, places_of(names, clip, shot, str(path)), strict=True):
        parts = [] if place is None else [row for row in rows[names[place]] if row]
        masks = [decode(part, f"{path}, frame {number}") for part in parts]
        found.append(np.logical_or.reduce(masks) if masks else None)
    return found


def decode(runs: Any, where: str) -> Mask:
    """Returns the mask of COCO's run lengths, `[H, W]`.

    Args:
        runs: `size`, height and width, and `counts`: lengths of stretches of 0 and 1 in turn, column by column, as
            numbers or as COCO's letters of five bits each.
        where: the file and frame, for messages.

    Raises:
        DataError: they are no run lengths, or do not fill the picture.
    """
    try:
        height, width = (int(length) for length in runs["size"])
        counts = runs["counts"]
        lengths = _lengths(counts) if isinstance(counts, str) else [int(count) for count in counts]
    except (TypeError, KeyError, ValueError, IndexError) as error:
        raise DataError(f"{where}: no run lengths with size and counts (polygons are not read).") from error
    if not 0 < height * width <= MOST_PIXELS or min(lengths, default=0) < 0 or sum(lengths) != height * width:
        raise DataError(f"{where}: run lengths of {sum(lengths)} pixels for a mask of {width} x {height}.")
    values = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    return np.asarray(values.reshape(width, height).T)


def _lengths(letters: str) -> list[int]:
    """Returns COCO's compressed lengths: five bits a letter from 48 on, the sixth says that more follow.

    From the fourth on each is the difference to the one before the last.
    """
    lengths: list[int] = []
    place = 0
    while place < len(letters):
        value, shift, more = 0, 0, True
        while more:
            bits = ord(letters[place]) - 48
            if not 0 <= bits < 64:
                raise ValueError("no letter of run lengths")
            value |= (bits & 31) << shift
            more, place, shift = bool(bits & 32), place + 1, shift + 5
        if bits & 16:
            value -= 1 << shift
        lengths.append(value + lengths[-2] if len(lengths) > 2 else value)
    return lengths
