"""What hid the person in a run, kept in the run's folder so that another run can hide the very same pixels.

| file | content |
|---|---|
| `occlusion/manifest.json` | `size` of the stored pictures, and for each frame a rectangle, a mask's name or null |
| `occlusion/000010.png` | mask of the frame, 255 where it is hidden; frames with the same mask share one |

Rectangles are `[x, y, width, height]`; all pixels are those of the stored pictures, whatever size is trained on.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from occfusion.data.silhouette import Hidden, Silhouette
from occfusion.errors import DataError
from occfusion.files.atomic import write_json, write_png
from occfusion.files.images import read_mask
from occfusion.files.jsonfile import load_json

MANIFEST = "manifest.json"
FOLDER = "occlusion"
"""Name of the folder inside a run's."""

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
        return bool(json.loads(path.read_text(encoding="utf-8")) == content)
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
        raise DataError(f"{path}: has no table 'frames'; name the folder {FOLDER!r} of a run.")
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
