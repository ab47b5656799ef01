"""The same held-out views of several runs: input, each rendering, truth, error maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from occfusion.compare.reading import RunRecord
from occfusion.errors import DataError
from occfusion.evaluation.pictures import Image
from occfusion.files.images import read_rgb
from occfusion.files.jsonfile import parse_json
from occfusion.files.run_folder import RunFolder

MARGIN = 8
"""Pixels kept around whatever is not black in any picture of a view."""


@dataclass(frozen=True)
class GridRow:
    """One view as several runs show it.

    Attributes:
        view: the name of the view.
        cells: title and picture `[h, w, 3]`, all of one size.
    """

    view: str
    cells: list[tuple[str, Image]]


def picture_grid(runs: Sequence[RunRecord], names: Sequence[str]) -> tuple[list[GridRow], list[str]]:
    """Returns the rows of a scene's grid, and a remark for each run that cannot be shown.

    Only views that all shown runs have are in it; of several seeds of a method the first is shown.

    Args:
        runs: of one scene.
        names: of the runs' methods, in the same order.
    """
    shown: list[tuple[str, dict[str, dict[str, Image]]]] = []
    remarks = []
    for run, name in zip(runs, names, strict=True):
        if any(name == other for other, _ in shown):
            continue
        try:
            shown.append((name, _parts(RunFolder(run.folder).held_out_picture)))
        except DataError as error:
            remarks.append(f"{run.folder}: not in the pictures: {error}")
    if not shown:
        return [], remarks
    common = [view for view in shown[0][1] if all(view in views for _, views in shown)]
    rows = [_row(view, [(name, views[view]) for name, views in shown]) for view in common]
    if not common:
        remarks.append("the runs have no held-out view in common")
    return rows, remarks


def joined(rows: Sequence[GridRow]) -> Image:
    """Returns the whole grid as one picture, rows of different widths filled up with white."""
    lines = [np.concatenate([image for _, image in row.cells], axis=1) for row in rows]
    width = max(line.shape[1] for line in lines)
    return np.concatenate(
        [np.pad(line, ((0, 4), (0, width - line.shape[1]), (0, 0)), constant_values=255) for line in lines]
    )


def _row(view: str, runs: Sequence[tuple[str, dict[str, Image]]]) -> GridRow:
    first = runs[0][1]
    cells = [("input", first["input"])] + [(name, parts["rendering"]) for name, parts in runs]
    if "truth" in first:
        cells.append(("truth", first["truth"]))
    cells += [(f"error of {name}", parts["error"]) for name, parts in runs if "error" in parts]
    sizes = {image.shape for _, image in cells}
    if len(sizes) > 1:  # runs at several image sizes are shown as they are
        height, width = max(s[0] for s in sizes), max(s[1] for s in sizes)
        return GridRow(view, [(t, _filled(image, height, width)) for t, image in cells])
    lit = np.any([image.max(axis=2) > 0 for _, image in cells], axis=0)
    rows, columns = _span(lit.any(axis=1)), _span(lit.any(axis=0))
    return GridRow(view, [(title, image[rows, columns]) for title, image in cells])


def _filled(image: Image, height: int, width: int) -> Image:
    return np.pad(image, ((0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0)))


def _span(lit: np.ndarray) -> slice:
    where = np.flatnonzero(lit)
    if len(where) == 0:
        return slice(0, len(lit))
    return slice(max(int(where[0]) - MARGIN, 0), int(where[-1]) + 1 + MARGIN)


def _parts(path: Path) -> dict[str, dict[str, Image]]:
    """Returns the parts of a run's comparison picture by view.

    Raises:
        DataError: no such picture, no description beside it, or they do not fit.
    """
    description = path.with_suffix(".json")
    if not description.is_file():
        raise DataError(
            f"{description} is missing; evaluate again: the training command with evaluation.again=true"
        )
    picture = read_rgb(path)
    try:
        views = parse_json(description.read_text(encoding="utf-8"))["views"]
        result = {}
        for view in views:
            cut = {}
            for part, (x, y, width, height) in view["parts"].items():
                is_inside = min(x, y) >= 0 and y + height <= len(picture) and x + width <= picture.shape[1]
                if not is_inside or min(width, height) < 1:
                    raise ValueError(f"part {part} of view {view['name']} lies outside the picture")
                cut[part] = picture[y : y + height, x : x + width]
            if not {"input", "rendering"} <= cut.keys():
                raise ValueError(f"view {view['name']} has no input or rendering")
            result[str(view["name"])] = cut
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{description} does not describe the picture beside it ({error})") from error
    return result
