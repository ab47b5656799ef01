"""Taking the body that another tool found, instead of a fit of our own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from occfusion.data.posing import Poser
from occfusion.errors import DataError
from occfusion.fitting.batch import BodyBatch
from occfusion.fitting.heading import MIN_CONFIDENCE
from occfusion.fitting.pipeline import Fit
from occfusion.fitting.quality import landmarks_of, measure
from occfusion.fitting.solver import Solution
from occfusion.footage.landmarks import KeyPoints
from occfusion.human import Body
from occfusion.importing.bodies import read_bodies
from occfusion.importing.sources import Sources

FEWEST_POINTS = 30
"""Key points of all frames together, fewer of which do not say where a camera stands."""


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
    width, height = (round(length / scale) for length in sources.shot.size)
    found = read_bodies(path, tool, (width, height), Poser(body).pelvis, person)
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
    kept = replace(sources.at(places), notes=notes)
    solution = Solution(
        np.zeros(10) if embedded else found.betas, found.global_orient[rows], found.body_pose[rows],
        found.transl[rows], K,
    )  # fmt: skip
    if found.in_world:
        solution = stood(body, solution, kept.points)
        notes.append(
            "its place to the camera is not in the file: found from the key points, for a camera that stands."
        )
    return kept, Fit(solution, measure(body, solution, kept.points, kept.masks, kept.hidden), kept.points, [])


def stood(body: Body, solution: Solution, points: KeyPoints) -> Solution:
    """Returns bodies of a world in the camera, by the one turn and shift that lays them on the key points best.

    Raises:
        DataError: the key points say too little.
    """
    marks = landmarks_of(body, solution)
    sure = (points.confidence > MIN_CONFIDENCE) & (points.presence > 0)[:, None]
    if sure.sum() < FEWEST_POINTS:
        raise DataError(f"{int(sure.sum())} sure key points: too few to find the camera of these bodies by.")
    pixels = points.pixels[sure] - 0.5
    K = solution.K.copy()
    K[:2, 2] -= 0.5
    good, turn, shift, _ = cv2.solvePnPRansac(
        marks[sure], pixels, K, None, reprojectionError=0.05 * float(np.ptp(pixels[:, 1])), iterationsCount=500,
        flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not good:
        raise DataError("no camera shows these bodies where the key points are: are they of this clip?")
    R = cv2.Rodrigues(turn)[0]
    betas = torch.tensor(solution.betas, dtype=torch.float32)
    pelvis = BodyBatch(body, np.zeros(1, dtype=np.int64)).joints_at_rest(betas)[0].double().numpy()
    orients = np.stack([cv2.Rodrigues(R @ cv2.Rodrigues(o)[0])[0].reshape(3) for o in solution.global_orient])
    # smplx turns about the pelvis: p -> A (p - j) + j + t, and the world turns everything
    places = (solution.transl + pelvis) @ R.T + shift.reshape(3) - pelvis
    return Solution(solution.betas, orients, solution.body_pose, places, solution.K)
