"""A fitted body and the outlines of masks: drawn to where they are, left alone where it lies there already."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from occfusion.fitting.pipeline import Fit
from occfusion.fitting.quality import landmarks_of, measure, posed, silhouette
from occfusion.fitting.solver import Solution
from occfusion.footage.landmarks import KeyPoints
from occfusion.human import embedded_body
from occfusion.importing.aligning import aligned_with_masks
from occfusion.synth.motion import smooth_noise

FRAMES, SIDE = 16, 200
K = np.array([[240.0, 0.0, SIDE / 2], [0.0, 240.0, SIDE / 2], [0.0, 0.0, 1.0]])
LIMBS = [1, 2, 4, 5, 16, 17, 18, 19]


@pytest.fixture(scope="module")
def body():
    return embedded_body()


def true_solution() -> Solution:
    """Somebody before the camera, arms down and moving, y down and z away."""
    orient = np.tile([np.pi, 0.0, 0.0], (FRAMES, 1))
    turns = np.zeros((FRAMES, 24, 3))
    turns[:, 16, 2], turns[:, 17, 2] = -0.8, 0.8
    turns[:, LIMBS, 0] = 0.3 * smooth_noise(np.random.default_rng(1), FRAMES, len(LIMBS), 6.0)
    places = np.tile([0.0, 0.0, 2.9], (FRAMES, 1))
    return Solution(np.zeros(10), orient, turns[:, 1:].reshape(FRAMES, 69), places, K)


def off(solution: Solution, spread: float) -> Solution:
    """The same with limbs turned by errors that are smooth in time."""
    turns = solution.body_pose.reshape(FRAMES, 23, 3).copy()
    noise = smooth_noise(np.random.default_rng(2), FRAMES, 3 * len(LIMBS), 6.0).reshape(FRAMES, len(LIMBS), 3)
    turns[:, np.array(LIMBS) - 1] += spread * noise / noise.std()
    return replace(solution, body_pose=turns.reshape(FRAMES, 69))


def sources_of(body: Any, truth: Solution) -> Any:
    """Masks of the true bodies; every third frame of a clip."""
    faces = body.faces.numpy()
    masks = [silhouette(vertices, K, faces, (SIDE, SIDE)) for vertices, _ in posed(body, truth)]
    return SimpleNamespace(
        masks=masks, hidden=None, shot=SimpleNamespace(numbers=list(range(5, 5 + 3 * FRAMES, 3)))
    )


def fit_of(body: Any, solution: Solution, truth: Solution, masks: list[np.ndarray]) -> Fit:
    marks = landmarks_of(body, truth)
    pixels = marks[..., :2] / marks[..., 2:] * 240.0 + SIDE / 2
    points = KeyPoints(pixels, np.ones((FRAMES, 33)), None, np.ones(FRAMES))
    return Fit(solution, measure(body, solution, points, masks), points, [])


def joints(body: Any, solution: Solution) -> np.ndarray:
    return np.stack([found for _, found in posed(body, solution)])


def test_a_fit_beside_the_masks_is_drawn_to_them(body):
    truth = true_solution()
    sources, wrong = sources_of(body, truth), off(truth, 0.12)
    fit = fit_of(body, wrong, truth, sources.masks)
    found = aligned_with_masks(body, sources, fit)
    wanted = joints(body, truth)
    before, after = (
        np.linalg.norm(joints(body, solution) - wanted, axis=2).mean() for solution in (wrong, found.solution)
    )
    assert after < 0.8 * before
    assert np.median(found.quality.iou) > np.median(fit.quality.iou) + 0.01
    assert np.array_equal(found.solution.betas, wrong.betas) and np.array_equal(found.solution.K, K)
    assert found.points is fit.points and fit.solution is wrong  # what was given stays as it was


def test_a_fit_on_the_masks_and_one_without_any_stay(body):
    truth = true_solution()
    sources = sources_of(body, truth)
    fit = fit_of(body, truth, truth, sources.masks)
    assert aligned_with_masks(body, sources, fit) is fit
    wrong = fit_of(body, off(truth, 0.12), truth, sources.masks)
    sources.masks = []
    assert aligned_with_masks(body, sources, wrong) is wrong
