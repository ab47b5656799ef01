"""Simulated occluders that are no rectangles: random polygons, and masks from files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.data.listing import pictures_in
from occfusion.data.silhouette import Silhouette
from occfusion.data.stored_occlusion import FOLDER, is_stored
from occfusion.errors import DataError
from occfusion.files.images import read_mask

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
    if is_stored(folder / FOLDER):
        raise DataError(f"{folder}: is a run; name its folder {folder / FOLDER} to hide what it hid.")
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
