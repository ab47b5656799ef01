"""Which picture of a video folder has which mask."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from occfusion.data.listing import last_number, partners
from occfusion.errors import DataError


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
        return Pairs(
            list(names), dict(zip(names, partners(names, dict(masks), folder), strict=True)), len(names), 0
        )
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
