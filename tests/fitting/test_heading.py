"""Headings of people whose trunk is hidden, and the path through time that they are chosen on."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from occfusion.fitting.anchors import landmark_places
from occfusion.fitting.batch import BodyBatch, rotations_of
from occfusion.fitting.heading import TRUNK, cheapest_path, facing, hidden_headings, upright
from occfusion.fitting.pipeline import fit_body
from occfusion.fitting.prior import mean_pose
from occfusion.fitting.quality import posed
from occfusion.footage.landmarks import INDEX, KeyPoints
from occfusion.human import embedded_body
from occfusion.synth.motion import make_take

K = np.array([[500.0, 0, 160], [0, 500.0, 240], [0, 0, 1]])
FRAMES, SEEN = 40, 32  # the trunk is hidden up to the second


def aligned_error(ours: np.ndarray, truth: np.ndarray) -> float:
    """Mean distance of joints after the best rotation and shift, metres."""
    turn, _ = Rotation.align_vectors(truth - truth.mean(axis=0), ours - ours.mean(axis=0))
    return float(
        np.linalg.norm(turn.apply(ours - ours.mean(axis=0)) - truth + truth.mean(axis=0), axis=1).mean()
    )


def test_the_path_is_the_cheapest_of_all():
    rng = np.random.default_rng(0)
    for _ in range(5):
        cost, step = rng.uniform(size=(4, 5)), rng.uniform(size=(5, 5))
        every = {
            path: cost[range(4), path].sum() + sum(step[a, b] for a, b in pairwise(path))
            for path in product(range(5), repeat=4)
        }
        assert tuple(cheapest_path(cost, step)) == min(every, key=every.__getitem__)


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.5])
def test_a_heading_is_that_of_its_rotation(angle):
    assert facing(upright(angle)) == pytest.approx(angle)
    assert np.linalg.det(upright(angle)) == pytest.approx(1.0)
    np.testing.assert_allclose(upright(0.0) @ [0, 0, 1], [0, 0, -1], atol=1e-12)  # towards the camera


@pytest.fixture(scope="module")
def turning():
    """Somebody who turns round, trunk, head and one arm behind something in four fifths of the frames; the truth."""
    take = make_take(FRAMES, np.zeros(10), False, np.random.default_rng(4))
    poses = torch.tensor(take.poses, dtype=torch.float32)
    batch = BodyBatch(embedded_body(), np.zeros(1, dtype=np.int64))
    rotations = rotations_of(poses[:, :3], poses[:, 3:])
    rotations[:, 0] = torch.diag(torch.tensor([1.0, -1.0, -1.0])) @ rotations[:, 0]
    turns, places = batch.transforms(
        torch.zeros(10), rotations, torch.tensor([[0.0, 0, 3.5]]).repeat(FRAMES, 1)
    )
    marks = landmark_places(turns, places).double().numpy()
    sure = np.ones((FRAMES, 33))
    sure[:SEEN, [*range(11), *TRUNK]] = 0
    pixels = marks[..., :2] / marks[..., 2:] * 500 + K[:2, 2]
    pixels[sure == 0] = 0.0
    return (
        KeyPoints(pixels, sure, None, np.ones(FRAMES)),
        batch,
        turns[:, 0].double().numpy(),
        places.double().numpy(),
    )


def test_limbs_say_which_way_a_hidden_trunk_faces(turning):
    points, batch, turns, places = turning
    known = {k: facing(turns[k]) for k in range(SEEN, FRAMES)}
    scale = np.full(FRAMES, 500 / 3.5)
    headings, middles = hidden_headings(points, known, scale, batch, mean_pose(), torch.zeros(10))
    true = np.array([facing(turn) for turn in turns])
    off = np.abs((headings - true + np.pi) % (2 * np.pi) - np.pi)[:SEEN]
    assert np.median(off) < np.radians(25) and np.isnan(headings[SEEN:]).all()
    hips = places[:SEEN, [1, 2]].mean(axis=1)
    wanted = hips[:, :2] / hips[:, 2:] * 500 + K[:2, 2]
    assert np.median(np.linalg.norm(middles[:SEEN] - wanted, axis=1)) < 0.15 * 500 / 3.5  # a start


def test_frames_with_few_landmarks_stay_open(turning):
    points, batch, turns, _ = turning
    sure = points.confidence.copy()
    sure[5] = 0
    sure[5, INDEX["left_wrist"]] = 1
    blind = KeyPoints(points.pixels, sure, None, points.presence)
    known = {k: facing(turns[k]) for k in range(SEEN, FRAMES)}
    headings, _ = hidden_headings(
        blind, known, np.full(FRAMES, 500 / 3.5), batch, mean_pose(), torch.zeros(10)
    )
    assert np.isnan(headings[5]) and np.isfinite(headings[4])


def test_a_body_is_fitted_in_every_frame_behind_something(turning):
    points, _, _, places = turning
    fit = fit_body(embedded_body(), points, None, K, [0.1 * k for k in range(FRAMES)])

    ours = [joints for _, joints in posed(embedded_body(), fit.solution)]
    errors = [aligned_error(a, b) for a, b in zip(ours, places, strict=True)]
    assert np.mean(errors) < 0.09 and np.median(fit.quality.pixels) < 1.5
