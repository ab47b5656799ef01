"""The correction of landmarks in space: what it must not depend on, and that it is the stored network."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from occfusion.footage import lift
from occfusion.footage.landmarks import COUNT, INDEX, KeyPoints
from occfusion.footage.lift import HIPS, MOST, SHOULDERS, inputs, lifted, turned_upright


def seen(frames: int = 5) -> KeyPoints:
    rng = np.random.default_rng(0)
    presence = np.ones(frames)
    presence[2] = 0
    return KeyPoints(
        rng.uniform(0, 300, (frames, COUNT, 2)), rng.uniform(0, 1, (frames, COUNT)),
        rng.normal(0, 0.4, (frames, COUNT, 3)), presence,
    )  # fmt: skip


def test_a_person_s_place_and_size_in_the_picture_do_not_matter():
    points = seen()
    moved = KeyPoints(3.0 * points.pixels + 70.0, points.confidence, points.world + 2.0, points.presence)
    one, other = lifted(points), lifted(moved)
    rows = points.presence > 0
    np.testing.assert_allclose(one.world[rows], other.world[rows], atol=1e-9)
    np.testing.assert_array_equal(one.pixels, points.pixels)
    np.testing.assert_array_equal(one.world[2], points.world[2])


@pytest.mark.parametrize("degrees", [20.0, -35.0, 90.0, 180.0])
def test_a_camera_that_is_held_askew_turns_the_corrections_with_it(degrees):
    points = seen()
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    world = points.world.copy()
    world[..., :2] = world[..., :2] @ turn.T
    askew = KeyPoints(points.pixels @ turn.T, points.confidence, world, points.presence)
    expected = lifted(points).world
    expected[..., :2] = expected[..., :2] @ turn.T
    rows = points.presence > 0
    np.testing.assert_allclose(lifted(askew).world[rows], expected[rows], atol=1e-9)


def test_the_trunk_is_upright_where_the_network_sees_it():
    points = seen()
    for turn, places in zip(turned_upright(points.pixels), points.pixels, strict=True):
        assert np.isclose(np.linalg.det(turn), 1.0)
        across, down = turn @ (places[SHOULDERS].mean(axis=0) - places[HIPS].mean(axis=0))
        assert abs(across) < 1e-9 and down < 0  # y is down


def test_it_is_the_stored_network_and_moves_nothing_far():
    points = seen()
    net = torch.nn.Sequential(torch.nn.Linear(198, 128), torch.nn.SiLU(), torch.nn.Linear(128, 128), torch.nn.SiLU(),
                              torch.nn.Linear(128, 99)).double()  # fmt: skip
    for layer, (weight, bias) in zip(net[::2], lift._layers(), strict=True):
        layer.weight.data, layer.bias.data = torch.tensor(weight), torch.tensor(bias)
    turns = turned_upright(points.pixels)
    pixels, upright = points.pixels.copy(), points.world.copy()
    for k, turn in enumerate(turns):
        pixels[k] = [turn @ place for place in points.pixels[k]]
        upright[k, :, :2] = [turn @ place for place in points.world[k, :, :2]]
    with torch.no_grad():
        moved = MOST * torch.tanh(net(torch.tensor(inputs(upright, pixels, points.confidence))))
    expected = upright - upright[:, HIPS].mean(axis=1, keepdims=True) + moved.reshape(-1, COUNT, 3).numpy()
    for k, turn in enumerate(turns):
        expected[k, :, :2] = [turn.T @ place for place in expected[k, :, :2]]
    rows = points.presence > 0
    np.testing.assert_allclose(lifted(points).world[rows], expected[rows], atol=1e-12)
    assert float(moved.abs().max()) <= MOST


def test_key_points_without_depth_stay_as_they_are():
    points = seen()
    flat = KeyPoints(points.pixels, points.confidence, None, points.presence)
    assert lifted(flat) is flat and INDEX["left_hip"] in HIPS
