"""Whose program wrote a video folder, as far as it matters: where the middle of the first pixel is.

InstantAvatar shoots the ray of pixel (x, y) through `K^-1 (x, y, 1)` and undistorts by OpenCV, so that the middle
of the first pixel is 0 for its principal points. COLMAP and this package count it as 0.5. Both keep the same names,
so other marks decide: what only InstantAvatar's scripts leave in a folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from occfusion.data.checking import checks
from occfusion.data.folder_contents import last_number, partners
from occfusion.data.video.pose_table import THETAS
from occfusion.data.video.pose_tracks import FIRST, Tracks, pose_files
from occfusion.errors import ConfigError, DataError
from occfusion.files.images import MASK_ARRAY


@dataclass(frozen=True)
class Pairs:
    """Pictures and masks.

    Attributes:
        names: pictures in order, without those after the last mask.
        masks: mask by picture; some pictures may have none.
        pictures: how many there are in the folder.
        lone_masks: masks that belong to no picture.
    """

    names: list[str]
    masks: dict[str, Path]
    pictures: int
    lone_masks: int

    @property
    def unmasked(self) -> int:
        """How many pictures have no mask."""
        return self.pictures - len(self.masks)


def pair(names: Sequence[str], masks: Mapping[str, Path], folder: Path, *, complete: bool) -> Pairs:
    """Returns what belongs together: the same name, or else the same last number.

    PeopleSnapshot's pictures are decoded from a video and its masks come from another file, so that their numbers
    can differ by a few at the end.

    Args:
        names: pictures without suffix, in order.
        masks: masks by name without suffix.
        folder: the masks' folder, for messages.
        complete: each picture must have a mask and each mask a picture.

    Raises:
        DataError: something that must have a partner has none.
    """
    if complete:
        own = zip(names, partners(names, dict(masks), folder), strict=True)
        return Pairs(list(names), dict(own), len(names), 0)
    by_number = {last_number(name): path for name, path in masks.items()}
    same = all(name in masks for name in names)
    chosen = {name: masks.get(name) if same else by_number.get(last_number(name)) for name in names}
    found = {name: path for name, path in chosen.items() if path is not None}
    if not found:
        raise DataError(
            f"{folder}: none of its {len(masks)} masks, the first {next(iter(masks))!r}, belongs to any of the "
            f"{len(names)} pictures, the first {names[0]!r}; names or last numbers must be the same."
        )
    last = max(k for k, name in enumerate(names) if name in found)
    lone = len(masks) - len(set(found.values()))
    return Pairs(list(names[: last + 1]), found, len(names), lone)


AUTO, OURS, WHOLE = "auto", 0.5, 0.0
CENTRES = "pixel_centres"
"""Key of `cameras.npz` by which a program may say it: 0 or 0.5."""

ROMP_VIEW = 60.0
"""Degrees across the longer side of the camera that ROMP assumes for every video."""

_SAME_FOCAL = 1e-6


@dataclass(frozen=True)
class Form:
    """What was found out.

    Attributes:
        marks: what shows that InstantAvatar's scripts wrote the folder, in words; empty where nothing does.
        shift: added to the stored principal points.
        centres: the same in words.
        assumed_camera: the camera is the one that ROMP assumes, not a calibrated one.
    """

    marks: tuple[str, ...]
    shift: float
    centres: str
    assumed_camera: bool


def instantavatar_marks(folder: Path, masks: Mapping[str, Path]) -> tuple[str, ...]:
    """Returns what shows that InstantAvatar's scripts wrote a folder, in words."""
    marks = []
    if any(path.suffix.lower() == MASK_ARRAY for path in masks.values()):
        marks.append("masks are arrays")
    marks += [name for name in pose_files(folder) if name != FIRST][:1]
    return tuple(marks)


def find_form(
    marks: tuple[str, ...], tracks: Tracks, camera: Mapping[str, Any], asked: object, file: Path
) -> Form:
    """Returns where pixel centres are in a folder.

    Args:
        marks: of `instantavatar_marks`.
        tracks: the pose files read.
        camera: content of `cameras.npz`.
        asked: `dataset.pixel_centres`: `auto`, 0 or 0.5.
        file: `cameras.npz`, for messages.

    Raises:
        ConfigError: `asked` is none of these.
        DataError: the file itself says something else than 0 or 0.5.
    """
    assumed = is_assumed_camera(camera)
    marks += ("poses have thetas",) if any(track.motion.form == THETAS for track in tracks.read) else ()
    marks += ("the camera is the one that ROMP assumes",) if assumed else ()
    if asked != AUTO:
        if isinstance(asked, bool) or asked not in (WHOLE, OURS):
            raise ConfigError(f"dataset.pixel_centres={asked!r}: choose {AUTO}, {WHOLE:g} or {OURS:g}.")
        centre, why = float(str(asked)), "dataset.pixel_centres"
    elif CENTRES in camera:
        why = f"{file.name} says so"
        centre = float(checks.numbers(camera[CENTRES], 1, f"{file}, {CENTRES}")[0])
        if centre not in (WHOLE, OURS):
            raise DataError(f"{file}, {CENTRES} is {centre:g}; it must be {WHOLE:g} or {OURS:g}.")
    elif marks:
        centre, why = WHOLE, f"InstantAvatar's: {', '.join(marks)}"
    else:
        why = f"no mark of InstantAvatar's scripts; dataset.pixel_centres={WHOLE:g} if it is theirs"
        centre = OURS
    return Form(marks, OURS - centre, f"the middle of the first pixel is {centre:g} ({why})", assumed)


def is_assumed_camera(camera: Mapping[str, Any]) -> bool:
    """Whether a camera is the one that ROMP assumes: 60 degrees, the picture's middle, at the origin."""
    try:
        K = checks.numbers(camera["intrinsic"], (3, 3), "intrinsic")
        view = checks.numbers(camera["extrinsic"], (4, 4), "extrinsic")
        width, height = (float(checks.numbers(camera[key], 1, key)[0]) for key in ("width", "height"))
    except (KeyError, DataError):
        return False
    focal = max(width, height) / 2 / np.tan(np.radians(ROMP_VIEW / 2))
    assumed = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return bool(np.array_equal(view, np.eye(4)) and np.abs(K - assumed).max() <= _SAME_FOCAL * focal)
