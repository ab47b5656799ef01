"""Simulated occlusion: which part of each training picture is hidden.

The paper hides a fixed full-height strip of columns during the first 80 % of a ZJU-MoCap sequence; its
columns are a table for six subjects. All positions here are in pixels of the stored picture, so that
they do not depend on the size that is trained on.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from occfusion.data.occluders import from_files, is_stored, polygons, read_occlusion
from occfusion.data.silhouette import Hidden, Silhouette
from occfusion.errors import ConfigError, DataError
from occfusion.fields import check_fields, read_record, setting
from occfusion.types import Box

TABLE_WIDTH = 1024
"""`mid` and `width` count columns of a picture this wide, the size of ZJU-MoCap."""

STRIPS = {
    "377": (460, 70),
    "386": (415, 80),
    "387": (448, 50),
    "392": (417, 78),
    "393": (434, 68),
    "394": (418, 64),
}
"""(mid, width) of the paper's six ZJU-MoCap subjects."""

GROUP = "dataset.occlusion"
KINDS = ("none", "strip", "box", "moving", "polygons", "files")
_ZJU_NAME = re.compile(r"(?:CoreView_|my_)?(\d{3})\Z")


def zju_subject(scene: str) -> str | None:
    """Returns the number of a ZJU-MoCap subject from its folder's name, None for any other name."""
    found = _ZJU_NAME.match(scene)
    return found[1] if found else None


@dataclass(frozen=True)
class OcclusionSettings:
    """What is hidden from the training camera; held-out cameras see everything."""

    kind: str = setting(
        "none",
        "`none`; `strip`: full height, fixed columns; `box`: around the person's centre in each frame; `moving`: a "
        "full-height bar that sweeps over the person's range; `polygons`: a random one over the person in each frame; "
        "`files`: the masks of a folder, in order",
        choices=KINDS,
    )
    fraction: float = setting(0.8, "share of the training frames, from the first on, that are occluded", 0, 1)
    share: float = setting(
        0.5, "share of the person to hide, mean over the occluded frames, where the width is not given", 0, 1
    )
    mid: float | None = setting(
        None,
        "middle column of the strip, of a picture 1024 wide; null: the protocol's, else from the masks",
        0,
        TABLE_WIDTH,
    )
    width: float | None = setting(
        None,
        "columns of the strip or bar, of a picture 1024 wide; null: the protocol's, else from the masks",
        0,
        TABLE_WIDTH,
    )
    sweeps: float = setting(
        2.0, "how often the moving bar crosses the person's range during the occluded frames", 0, 1000
    )
    seed: int = setting(
        0, "of the polygons; the same for all variants of a run, whatever their own seed", 0, 2**32 - 1
    )
    folder: str | None = setting(
        None,
        "of `files`: masks, not 0 where something is hidden, of the size of the stored pictures; or the folder "
        "`occlusion` of a run, to hide what that run hid",
    )
    until: int | None = setting(
        None,
        "frames of the sequence below this number are occluded, in place of `fraction`; null: OccNeRF's protocol has "
        "its own, else by `fraction`",
        0,
        repr=False,  # what it hides is in the data's hash
    )

    def __post_init__(self) -> None:
        check_fields(self, GROUP)
        if self.kind == "files" and not self.folder:
            raise ConfigError(
                "dataset.occlusion.kind=files needs dataset.occlusion.folder, a folder of masks."
            )

    @classmethod
    def parse(cls, value: str | Mapping[str, Any] | OcclusionSettings | None) -> OcclusionSettings:
        """Returns the settings of a kind's name or of a mapping with the key `kind` and its parameters.

        Raises:
            ConfigError: an unknown kind or key, or a value out of its range.
        """
        if isinstance(value, OcclusionSettings):
            return value
        if value is None or isinstance(value, str):
            return cls(kind=value or "none")
        if not isinstance(value, Mapping):
            raise ConfigError(f"dataset.occlusion={value!r}: give one of {', '.join(KINDS)}, or a mapping.")
        return read_record(cls, value, GROUP)


def plan(
    settings: OcclusionSettings,
    silhouettes: Sequence[Silhouette],
    scene_name: str,
    frames: Sequence[int] | None = None,
) -> tuple[Hidden | None, ...]:
    """Returns what is hidden in each training frame, in pixels of the stored picture, or None.

    Args:
        settings: the kind and its parameters.
        silhouettes: the whole person in each training frame, in order.
        scene_name: decides whether the paper's table applies.
        frames: their numbers in the sequence, by which a run's stored occlusion is found; 0, 1, ... when None.

    Raises:
        DataError: the position must come from the data and no frame shows a person; or masks are missing,
            damaged or of another size.
    """
    folder = Path(settings.folder or "")
    if settings.kind == "files" and is_stored(folder) and silhouettes:
        # which frames are occluded was decided by that run; `fraction` has no say
        numbers, size = frames or range(len(silhouettes)), (silhouettes[0].width, silhouettes[0].height)
        return tuple(read_occlusion(folder, numbers, size))
    occluded = round(settings.fraction * len(silhouettes))
    if settings.until is not None:
        occluded = sum(number < settings.until for number in frames or range(len(silhouettes)))
    if settings.kind == "none" or occluded == 0:
        return (None,) * len(silhouettes)
    if settings.kind == "strip":
        boxes: list[Hidden | None] = [_strip(settings, silhouettes, occluded, scene_name)] * occluded
    elif settings.kind == "box":
        boxes = [_centre_box(settings.share, silhouette) for silhouette in silhouettes[:occluded]]
    elif settings.kind == "moving":
        boxes = list(_moving(settings, silhouettes[:occluded]))
    elif settings.kind == "polygons":
        boxes = list(polygons(silhouettes[:occluded], settings.share, settings.seed))
    else:
        boxes = list(from_files(folder, silhouettes[:occluded]))
    return (*boxes, *(None,) * (len(silhouettes) - occluded))


def strip_columns(mid: float, width: float, picture_width: int) -> tuple[int, int]:
    """Returns the columns `[mid - width // 2, mid + width // 2)` of the table, in pixels of the picture."""
    half, scale = width // 2, picture_width / TABLE_WIDTH
    first, last = round((mid - half) * scale), round((mid + half) * scale)
    return min(max(first, 0), picture_width), min(max(last, 0), picture_width)


def _strip(
    settings: OcclusionSettings, silhouettes: Sequence[Silhouette], occluded: int, scene_name: str
) -> Box | None:
    picture = silhouettes[0]
    table = STRIPS.get(zju_subject(scene_name) or "")
    mid: float | None = settings.mid if settings.mid is not None or table is None else table[0]
    width: float | None = settings.width if settings.width is not None or table is None else table[1]
    scale = picture.width / TABLE_WIDTH
    if mid is None:
        mid = _median_column(silhouettes) / scale
    if width is None:
        width = 2 * _half_width(silhouettes[:occluded], mid * scale, settings.share) / scale
        first, last = round(mid * scale - width * scale / 2), round(mid * scale + width * scale / 2)
        first, last = max(first, 0), min(last, picture.width)
    else:
        first, last = strip_columns(mid, width, picture.width)
    return (first, 0, last - first, picture.height) if last > first else None


def _median_column(silhouettes: Sequence[Silhouette]) -> int:
    """Returns the column with half of all the person's pixels to its left, over all training frames."""
    counts = np.sum([silhouette.columns() for silhouette in silhouettes], axis=0)
    if counts.sum() == 0:
        raise DataError("no training frame shows a person; the strip's place cannot be found from the masks.")
    return int(np.searchsorted(np.cumsum(counts), counts.sum() / 2))


def _half_width(silhouettes: Sequence[Silhouette], mid: float, share: float) -> int:
    """Returns the half width whose strip around `mid` hides a share nearest to `share`, in the mean."""
    seen = [silhouette.columns() for silhouette in silhouettes if not silhouette.empty]
    if not seen:
        raise DataError("no occluded frame shows a person; give dataset.occlusion.width.")
    weights = np.mean([columns / columns.sum() for columns in seen], axis=0)
    before = np.concatenate([[0.0], np.cumsum(weights)])  # share of the person left of each column edge
    halves = np.arange(len(weights) + 1)
    first = np.clip(round(mid) - halves, 0, len(weights))
    last = np.clip(round(mid) + halves, 0, len(weights))
    return int(np.abs(before[last] - before[first] - share).argmin())


def _centre_box(share: float, silhouette: Silhouette) -> Box | None:
    """Returns a rectangle with the centre and the proportions of the person's, and `share` of its area."""
    x, y, w, h = silhouette.box
    side = math.sqrt(share)
    wide, high = round(w * side), round(h * side)
    if wide == 0 or high == 0:
        return None
    return x + (w - wide) // 2, y + (h - high) // 2, wide, high


def _moving(settings: OcclusionSettings, silhouettes: Sequence[Silhouette]) -> list[Box | None]:
    """Returns a bar that goes to and fro between the ends of the person's range."""
    seen = [silhouette.box for silhouette in silhouettes if not silhouette.empty]
    if not seen:
        raise DataError("no occluded frame shows a person; the bar's range cannot be found from the masks.")
    picture = silhouettes[0]
    scale = picture.width / TABLE_WIDTH
    left, right = min(box[0] for box in seen), max(box[0] + box[2] for box in seen)
    wanted = settings.share * float(np.median([box[2] for box in seen]))
    width = round(wanted if settings.width is None else settings.width * scale)
    bars: list[Box | None] = []
    for index in range(len(silhouettes)):
        phase = settings.sweeps * index / max(len(silhouettes) - 1, 1)
        place = 1.0 - abs(phase % 2.0 - 1.0)  # 0 at the left end, 1 at the right, back again
        middle = left + place * (right - left)
        first, last = max(round(middle - width / 2), 0), min(round(middle + width / 2), picture.width)
        bars.append((first, 0, last - first, picture.height) if last > first else None)
    return bars
