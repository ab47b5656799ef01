"""The fit finds a body again from what it projects to; its parts against slow reckonings."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from occfusion.errors import DataError
from occfusion.fitting.anchors import landmark_places
from occfusion.fitting.batch import BodyBatch, height_at_rest, rotations_of, spread_vertices
from occfusion.fitting.heading import exchanged, swapped_frames
from occfusion.fitting.pipeline import fit_body
from occfusion.fitting.prior import beyond_limits, mirrored, unlikely
from occfusion.footage.landmarks import INDEX, KeyPoints
from occfusion.human import embedded_body
from occfusion.synth.motion import make_take

K = np.array([[500.0, 0, 160], [0, 500.0, 240], [0, 0, 1]])


def observed(frames: int = 12, seed: int = 3):
    """Returns key points of a moving person in front of a camera, and the true joints."""
    take = make_take(60, np.zeros(10), False, np.random.default_rng(seed), turn=40.0)
    poses = torch.tensor(take.poses[:frames], dtype=torch.float32)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    batch = BodyBatch(embedded_body(), np.zeros(1, dtype=np.int64))
    betas = torch.zeros(10)
    betas[1] = 1.0
    rotations = rotations_of(poses[:, :3], poses[:, 3:])
    rotations[:, 0] = flip @ rotations[:, 0]
    transl = torch.tensor(take.transl[:frames], dtype=torch.float32) * 0 + torch.tensor([0.0, 0.0, 3.5])
    turns, places = batch.transforms(betas, rotations, transl)
    marks = landmark_places(turns, places).double().numpy()
    pixels = marks[..., :2] / marks[..., 2:] * 500 + K[:2, 2]
    hips = marks[:, [INDEX["left_hip"], INDEX["right_hip"]]].mean(axis=1, keepdims=True)
    points = KeyPoints(pixels, np.ones((frames, 33)), marks - hips, np.ones(frames))
    return points, places.double().numpy()


def aligned_error(ours: np.ndarray, truth: np.ndarray) -> float:
    a, b = ours - ours.mean(axis=0), truth - truth.mean(axis=0)
    u, _, v = np.linalg.svd(a.T @ b)
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ v))]) @ v
    return float(np.linalg.norm(a @ turn - b, axis=1).mean())


def test_batched_bodies_are_the_bodies_one_by_one():
    body = embedded_body()
    chosen = spread_vertices(body, 40)
    batch = BodyBatch(body, chosen)
    generator = torch.Generator().manual_seed(0)
    betas = torch.randn(10, generator=generator)
    orient, pose = torch.randn(3, 3, generator=generator), 0.4 * torch.randn(3, 69, generator=generator)
    transl = torch.randn(3, 3, generator=generator)
    turns, places = batch.transforms(betas, rotations_of(orient, pose), transl)
    points = batch.points(betas, turns, places)
    for k in range(3):
        vertices, joints = body(betas, orient[k], pose[k], transl[k])
        torch.testing.assert_close(places[k], joints, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(points[k], vertices[chosen], atol=1e-5, rtol=1e-5)


def test_a_person_is_found_again_from_key_points():
    points, truth = observed()
    fit = fit_body(embedded_body(), points, None, K, np.arange(12) / 10)
    places = _joints(fit.solution)
    errors = [aligned_error(a, b) for a, b in zip(places, truth, strict=True)]
    assert np.mean(errors) < 0.03
    assert fit.quality.summary()["median_reprojection_percent_of_height"] < 1.0
    assert fit.quality.trusted and fit.quality.doubtful == [] and fit.swapped == []


@pytest.mark.slow
def test_the_height_that_is_given_is_the_bodys_and_its_place_follows():
    points, truth = observed()
    body, far = embedded_body(), truth[:, 0, 2].mean()
    betas = torch.zeros(10)
    betas[1] = 1.0
    size = float(height_at_rest(body, betas))  # the person's own
    for given in (0.85 * size, size, 1.15 * size):
        fit = fit_body(body, points, None, K, np.arange(12) / 10, height=given)
        found = float(height_at_rest(body, torch.tensor(fit.solution.betas, dtype=torch.float32)))
        assert abs(found / given - 1.0) < 0.01
        away = _joints(fit.solution)[:, 0, 2].mean()
        assert abs(away / far - given / size) < 0.03  # twice as tall is twice as far
        assert fit.quality.summary()["median_reprojection_percent_of_height"] < 1.0


def test_the_height_at_rest_is_that_of_the_bodys_own_vertices():
    body = embedded_body()
    for seed in range(3):
        betas = torch.randn(10, generator=torch.Generator().manual_seed(seed))
        vertices, _ = body(betas, torch.zeros(3), torch.zeros(69), torch.zeros(3))
        expected = float(vertices[:, 1].max() - vertices[:, 1].min())
        assert abs(float(height_at_rest(body, betas)) - expected) < 1e-3


def test_outliers_and_hidden_points_do_not_pull_the_body_away():
    points, truth = observed()
    rng = np.random.default_rng(1)
    wrong = rng.integers(0, 33, 12)
    points.pixels[np.arange(12), wrong] += 150
    points.confidence[:, INDEX["left_wrist"]] = 0.0
    points.pixels[:, INDEX["left_wrist"]] = 0.0
    fit = fit_body(embedded_body(), points, None, K, np.arange(12) / 10)
    errors = [aligned_error(a, b) for a, b in zip(_joints(fit.solution), truth, strict=True)]
    assert np.mean(errors) < 0.06


def test_exchanged_sides_are_caught():
    points, _ = observed(frames=20)
    wrong = np.zeros(20, dtype=bool)
    wrong[[6, 7, 13]] = True
    np.testing.assert_array_equal(swapped_frames(exchanged(points, wrong)), wrong)
    assert not swapped_frames(points).any()


def test_key_points_that_are_of_no_body_are_not_trusted():
    points, _ = observed()
    rng = np.random.default_rng(0)
    noise = KeyPoints(rng.uniform(0, 320, points.pixels.shape), points.confidence, None, points.presence)
    assert not fit_body(embedded_body(), noise, None, K, np.arange(12) / 10).quality.trusted


def test_without_a_trunk_there_is_nothing_to_start_from():
    points, _ = observed()
    points.confidence[:, [11, 12, 23, 24]] = 0.0
    with pytest.raises(DataError, match="shoulders and hips"):
        fit_body(embedded_body(), points, None, K, np.arange(12) / 10)


def test_the_prior_knows_the_motions_and_both_sides_alike():
    poses = torch.tensor(make_take(50, np.zeros(10), False, np.random.default_rng(9)).poses[:, 3:]).float()
    assert unlikely(poses).mean() < 0.3 * unlikely(3 * torch.randn(50, 69)).mean()
    other = torch.tensor(mirrored(poses.numpy())).float()
    torch.testing.assert_close(unlikely(poses), unlikely(other), rtol=1e-3, atol=1e-3)
    backwards = torch.zeros(1, 69)
    backwards[0, 3 * 3] = -1.0  # a knee bent to the front
    assert beyond_limits(backwards) > 0.8 > beyond_limits(-backwards) + 0.7


def _joints(solution) -> np.ndarray:
    from occfusion.fitting.quality import posed

    return np.stack([joints for _, joints in posed(embedded_body(), solution)])
