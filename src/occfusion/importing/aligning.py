"""A fitted body put where the outlines of the masks have it, as training does with poses that it is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from occfusion.fitting.pipeline import Fit
from occfusion.fitting.quality import measure
from occfusion.human import Body
from occfusion.human.pose_spline import PoseSpline
from occfusion.importing.sources import Sources
from occfusion.observation.pose_alignment import aligned_pose
from occfusion.observation.pose_witness import Look
from occfusion.observation.sequence_alignment import align_sequence
from occfusion.types import Camera, Pose

KNOTS = 4
"""Frames from one knot of the corrections to the next, at most, as in training (`optim.pose_knots`)."""


def aligned_with_masks(body: Body, sources: Sources, fit: Fit) -> Fit:
    """Returns the fit with its poses aligned, or as it is: without masks, or where outlines do not say that it is off.

    Args:
        body: that was fitted.
        sources: what it was fitted to.
        fit: the body.
    """
    numbers = sources.shot.numbers
    poses = _poses_of(fit, numbers)
    if not sources.masks or len(poses) < 2:
        return fit
    height, width = sources.masks[0].shape
    camera = Camera(torch.eye(4), torch.tensor(fit.solution.K, dtype=torch.float32), width, height)

    def look_at(position: int) -> Look:
        look = Look.of(numbers[position], poses[position], camera, sources.masks[position])
        # a fit is off by more than the alignment's priors allow: all that outlines say is wanted against them
        return replace(look, points=None)

    # the camera is the fit's own, so that nothing is to be found of it
    alignment = align_sequence(look_at, numbers, body, KNOTS, registered=True)
    if alignment is None or not alignment.is_taken:
        return fit
    return moved(body, sources, fit, alignment.spline(), numbers)


def moved(body: Body, sources: Sources, fit: Fit, spline: PoseSpline, numbers: Sequence[int]) -> Fit:
    """Returns the fit with corrections in its poses, measured anew.

    Args:
        body: that was fitted.
        sources: what it was fitted to.
        fit: the body.
        spline: the corrections.
        numbers: which frames of the spline the fit's are.
    """
    corrected = [aligned_pose(pose, spline, body) for pose in _poses_of(fit, numbers)]
    orient, turns, places = (
        torch.stack([getattr(pose, name) for pose in corrected]).double().numpy()
        for name in ("global_orient", "body_pose", "transl")
    )
    solution = replace(fit.solution, global_orient=orient, body_pose=turns, transl=places)
    quality = measure(body, solution, fit.points, sources.masks, sources.hidden)
    return replace(fit, solution=solution, quality=quality)


def _poses_of(fit: Fit, numbers: Sequence[int]) -> list[Pose]:
    solution = fit.solution
    betas, orient, turns, places = (
        torch.tensor(values, dtype=torch.float32)
        for values in (solution.betas, solution.global_orient, solution.body_pose, solution.transl)
    )
    rows = zip(orient, turns, places, numbers, strict=True)
    return [Pose(betas, first, others, place, float(number)) for first, others, place, number in rows]
