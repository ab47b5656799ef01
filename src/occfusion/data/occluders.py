"""Simulated occluders that are no rectangles, and those of a run, kept so that another can hide the same pixels."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.data.folder_contents import pictures_in
from occfusion.data.silhouette import Hidden, Silhouette
from occfusion.errors import DataError
from occfusion.files.atomic import write_json, write_png
from occfusion.files.images import read_mask
from occfusion.files.jsonfile import load_json, parse_json
from occfusion.files.run_folder import RunFolder

MANIFEST = "manifest.json"

_MASK_NAME = re.compile(r"\d{6,12}\.png\Z")


def write_occlusion(
    folder: Path, hidden: Mapping[int, Hidden | None], size: tuple[int, int], about: Mapping[str, str]
) -> None:
    """Writes what was hidden; the manifest comes last, so that a folder with one is complete.

    What is there already, of the same content, is left as it is. Nothing is written where nothing was hidden.

    Args:
        folder: made when missing.
        hidden: by number of the frame in the sequence.
        size: (width, height) of the stored pictures.
        about: plain text for people who read the manifest.

    Raises:
        DataError: the disk refuses.
    """
    if not any(part is not None for part in hidden.values()):
        return
    names: dict[tuple[object, bytes], str] = {}
    masks: dict[str, Silhouette] = {}
    frames: dict[str, Any] = {}
    for frame, part in hidden.items():
        if isinstance(part, Silhouette):
            name = names.setdefault((part.box, part.bits.tobytes()), f"{frame:06d}.png")
            masks.setdefault(name, part)
            frames[str(frame)] = name
        else:
            frames[str(frame)] = None if part is None else list(part)
    content = {**about, "size": list(size), "frames": frames}
    if _is_there(folder, content, masks):
        return
    for name, mask in masks.items():
        write_png(folder / name, mask.full())
    write_json(folder / MANIFEST, content)


def _is_there(folder: Path, content: Mapping[str, Any], masks: Mapping[str, Silhouette]) -> bool:
    path = folder / MANIFEST
    if not path.is_file() or not all((folder / name).is_file() for name in masks):
        return False
    try:
        return bool(parse_json(path.read_text(encoding="utf-8")) == content)
    except ValueError:
        return False


def is_stored(folder: Path) -> bool:
    """Returns whether a folder holds what `write_occlusion` writes."""
    return (folder / MANIFEST).is_file()


def read_occlusion(folder: Path, frames: Sequence[int], size: tuple[int, int]) -> list[Hidden | None]:
    """Returns what a run hid in each of some frames, in their order.

    Args:
        folder: the folder `occlusion` of a run.
        frames: numbers of the frames in the sequence.
        size: (width, height) of the stored pictures.

    Raises:
        DataError: damaged, of pictures of another size, or without one of the frames.
    """
    path = folder / MANIFEST
    content = load_json(path)
    stored = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(stored, dict):
        name = RunFolder(folder).occlusion.name
        raise DataError(f"{path}: has no table 'frames'; name the folder {name!r} of a run.")
    if content.get("size") != list(size):
        raise DataError(
            f"{path}: belongs to pictures of size {content.get('size')}, but these have {list(size)}; what a run "
            "hid can be hidden again in the same stored pictures only."
        )
    lacking = [frame for frame in frames if str(frame) not in stored]
    if lacking:
        raise DataError(
            f"{path}: does not say what was hidden in frame {lacking[0]}"
            + (f" and {len(lacking) - 1} more" if len(lacking) > 1 else "")
            + "; choose dataset.train_frames among those of that run."
        )
    masks: dict[str, Silhouette] = {}
    return [_part(folder, stored[str(frame)], frame, size, masks) for frame in frames]


def _part(
    folder: Path, entry: Any, frame: int, size: tuple[int, int], masks: dict[str, Silhouette]
) -> Hidden | None:
    where = f"{folder / MANIFEST}, frame {frame}"
    if entry is None:
        return None
    if isinstance(entry, str):
        if not _MASK_NAME.match(entry):
            raise DataError(f"{where}: {entry[:80]!r} is no name of a mask in this folder.")
        if entry not in masks:
            masks[entry] = Silhouette.of(read_mask(folder / entry))
        mask = masks[entry]
        if (mask.width, mask.height) != size:
            raise DataError(
                f"{folder / entry}: {mask.width} x {mask.height} pixels, but the pictures have {size[0]} x {size[1]}."
            )
        return None if mask.empty else mask
    whole = isinstance(entry, list) and len(entry) == 4 and all(type(part) is int for part in entry)
    if not whole or min(entry) < 0 or entry[0] + entry[2] > size[0] or entry[1] + entry[3] > size[1]:
        raise DataError(
            f"{where}: {str(entry)[:80]} is no rectangle [x, y, width, height] inside the picture."
        )
    return entry[0], entry[1], entry[2], entry[3]


CORNERS = 9
INDENT = 0.45
"""Corners lie between this share of the polygon's reach and all of it: ragged, yet one piece."""

_HALVINGS = 14


def polygons(silhouettes: Sequence[Silhouette], share: float, seed: int) -> list[Silhouette | None]:
    """Returns a polygon for each frame that hides about `share` of the person, None where nobody is.

    The polygon of a frame is a function of the seed, the frame's position and the person's outline: its
    middle is a pixel of the person, its corners lie at random distances around it.
    """
    return [
        None if person.empty or share == 0 else _polygon(person, share, np.random.default_rng((seed, k)))
        for k, person in enumerate(silhouettes)
    ]


def _polygon(person: Silhouette, share: float, rng: np.random.Generator) -> Silhouette:
    mask = person.crop()
    rows, columns = np.nonzero(mask)
    chosen = int(rng.integers(len(rows)))
    middle = np.array([columns[chosen], rows[chosen]], dtype=np.float64)
    angles = np.sort((np.arange(CORNERS) + rng.uniform(0.1, 0.9, CORNERS)) * 2 * np.pi / CORNERS)
    reach = rng.uniform(INDENT, 1.0, CORNERS)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    low, high = 0.0, 4.0 * float(sum(mask.shape))
    for _ in range(_HALVINGS):
        size = (low + high) / 2
        covered = _filled(mask.shape, middle + size * reach)
        low, high = (size, high) if (covered & mask).sum() < share * len(rows) else (low, size)
    x, y, _, _ = person.box
    return Silhouette.of(_filled((person.height, person.width), middle + (x, y) + high * reach))


def _filled(shape: tuple[int, ...], corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    canvas = np.zeros(shape, dtype=np.uint8)
    cv2.fillPoly(canvas, [np.rint(corners).astype(np.int32)], 1)
    return canvas > 0


def from_files(folder: Path, silhouettes: Sequence[Silhouette]) -> list[Silhouette | None]:
    """Returns the masks of a folder in the order of their names, begun again when there are too few.

    Raises:
        DataError: no such folder, a run's, no picture in it, or one of another size than the data set's pictures.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; dataset.occlusion.folder must name one with masks.")
    of_run = RunFolder(folder).occlusion
    if is_stored(of_run):
        raise DataError(f"{folder}: is a run; name its folder {of_run} to hide what it hid.")
    files = list(pictures_in(folder).values())
    kept: dict[Path, Silhouette] = {}
    hidden: list[Silhouette | None] = []
    for position, person in enumerate(silhouettes):
        path = files[position % len(files)]
        if path not in kept:
            kept[path] = Silhouette.of(read_mask(path))
        mask = kept[path]
        if (mask.width, mask.height) != (person.width, person.height):
            raise DataError(
                f"{path}: {mask.width} x {mask.height} pixels, but the pictures have {person.width} x "
                f"{person.height}; occlusion masks must have the size of the stored pictures."
            )
        hidden.append(None if mask.empty else mask)
    return hidden
