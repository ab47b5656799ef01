"""Taking the body that another tool found, instead of a fit of our own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from occfusion.data.posing import Poser
from occfusion.errors import DataError
from occfusion.fitting.pipeline import Fit
from occfusion.fitting.quality import measure
from occfusion.fitting.solver import Solution
from occfusion.footage.clip import Shot
from occfusion.footage.landmarks import KeyPoints
from occfusion.human import Body
from occfusion.importing.bodies import read_bodies
from occfusion.importing.sources import Sources


def adopt(
    path: Path, tool: str | None, sources: Sources, body: Body, *, embedded: bool, person: int | None = None
) -> tuple[Sources, Fit]:
    """Returns the frames of a clip that a tool's file has a body for, and that body, measured against them.

    Args:
        path: the tool's file.
        tool: its name; None to tell from the content.
        sources: pictures, masks and key points, by which the body is measured.
        body: that the file's numbers are for.
        embedded: whether it is the free body, to which SMPL's shape numbers mean nothing.
        person: the tool's number of the wanted person.

    Raises:
        DataError: as `read_bodies`, or the file is of other frames than these.
    """
    scale = sources.shot.scale
    size = tuple(round(length / scale) for length in sources.shot.size)
    found = read_bodies(path, tool, (size[0], size[1]), Poser(body).pelvis, person)
    row = {int(frame): k for k, frame in enumerate(found.frames)}
    places = [k for k, number in enumerate(sources.shot.numbers) if number in row]
    if len(places) < 2:
        raise DataError(
            f"{path}: has bodies for the frames {found.frames.min()} to {found.frames.max()}, the clip's are "
            f"{sources.shot.numbers[0]} to {sources.shot.numbers[-1]}: is it of this clip?"
        )
    rows = [row[sources.shot.numbers[k]] for k in places]
    K = sources.intrinsics.K.copy()
    notes = [*sources.notes, f"body of {found.tool}, {path.name}", *found.notes]
    if found.K is not None:
        K = found.K.copy()
        K[:2] *= scale
        notes.append(f"camera of {path.name}.")
    if embedded:
        notes.append(
            "the free body has shape numbers of its own: its mean shape is used (--body SMPL.pkl for SMPL's)."
        )
    kept = Sources(
        sources.clip,
        Shot(
            [sources.shot.pictures[k] for k in places], [sources.shot.numbers[k] for k in places],
            [sources.shot.seconds[k] for k in places], scale, sources.shot.notes,
        ),
        _rows(sources.points, places), [sources.masks[k] for k in places], sources.intrinsics,
        None if sources.hidden is None else [sources.hidden[k] for k in places], notes,
    )  # fmt: skip
    solution = Solution(
        np.zeros(10) if embedded else found.betas, found.global_orient[rows], found.body_pose[rows],
        found.transl[rows], K,
    )  # fmt: skip
    return kept, Fit(solution, measure(body, solution, kept.points, kept.masks, kept.hidden), kept.points, [])


def _rows(points: KeyPoints, places: list[int]) -> KeyPoints:
    world = None if points.world is None else points.world[places]
    return KeyPoints(points.pixels[places], points.confidence[places], world, points.presence[places])
