"""What a video says of a surface, direction by direction: against sums by hand, and on bodies and boxes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from occfusion.geometry.coverage import GRAZING, Coverage, Sighting, cover
from occfusion.human.observability import Observability, observe_surface

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
FACES = np.asarray(BALL.faces, np.int64)
POINTS = np.asarray(BALL.vertices, np.float64)


def seen_from(angles: list[float], distance: float = 3.0, size: int = 160) -> Coverage:
    """The ball seen by cameras on a level circle about it."""
    found = cover((sighting(angle, distance, size) for angle in angles), FACES)
    assert found is not None
    return found


def sighting(angle: float, distance: float, size: int) -> Sighting:
    back = np.array([math.sin(angle), 0.0, math.cos(angle)])
    right = np.array([math.cos(angle), 0.0, -math.sin(angle)])
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, [0.0, -1.0, 0.0], -back])
    viewmat[:3, 3] = -viewmat[:3, :3] @ (distance * back)
    K = np.array([[4.0 * size, 0.0, size / 2], [0.0, 4.0 * size, size / 2], [0.0, 0.0, 1.0]])
    return Sighting.through(POINTS, viewmat, K, np.ones((size, size), bool))


@pytest.fixture(scope="module")
def from_front() -> Observability:
    return observe_surface(seen_from([0.0] * 10), POINTS, FACES)


@pytest.fixture(scope="module")
def from_all_round() -> Observability:
    return observe_surface(seen_from([2 * math.pi * k / 48 for k in range(48)]), POINTS, FACES)


def nearest_vertex(direction: tuple[float, float, float]) -> int:
    return int((POINTS @ np.array(direction)).argmax())


def of_outlines(known: Observability, *direction: float) -> np.ndarray:
    """How little outlines say along one direction everywhere."""
    return known.outline_ignorance(np.tile(direction, (len(POINTS), 1)))


def test_moments_are_sums_over_the_looks_by_hand():
    angles = [0.0, 0.3, -0.5, 1.1]
    known = observe_surface(seen_from(angles), POINTS, FACES)
    for vertex in (
        nearest_vertex((0, 0, 1)),
        nearest_vertex((0.6, 0.3, 0.7)),
        nearest_vertex((-0.5, -0.4, 0.6)),
    ):
        total, expected = 0.0, np.zeros((3, 3))
        for angle in angles:
            centre = 3.0 * np.array([math.sin(angle), 0.0, math.cos(angle)])
            d = centre - POINTS[vertex]
            d /= np.linalg.norm(d)
            cosine = float(d @ BALL.vertex_normals[vertex])
            assert abs(cosine - GRAZING) > 0.03  # normals differ by a little
            if cosine > GRAZING:
                total += cosine
                expected += cosine * np.outer(d, d)
        assert known.moments[vertex] == pytest.approx(expected / total, abs=0.02)


def test_one_camera_says_nothing_along_its_line_of_sight(from_front):
    front = nearest_vertex((0, 0, 1))
    assert abs(from_front.axis[front] @ [0, 0, 1]) > 0.999
    assert from_front.ignorance[front] > 0.99
    assert of_outlines(from_front, 0.0, 0, 1)[front] > 0.99
    assert of_outlines(from_front, 1.0, 0, 0)[front] < 0.05
    assert from_front.unseen[front] < 0.1


def test_what_no_camera_shows_is_not_known_but_for_its_outline(from_front):
    back = nearest_vertex((0, 0, -1))
    assert (
        not from_front.is_seen[back] and from_front.unseen[back] == 1.0 and from_front.ignorance[back] == 1.0
    )
    assert from_front.axis[back] == pytest.approx([0, 0, -1], abs=0.05)
    # but its outline is: from across, whichever side it faces
    assert of_outlines(from_front, 0.0, 0, 1)[back] > 0.99
    assert of_outlines(from_front, 1.0, 0, 0)[back] < 0.05


def test_who_is_seen_from_all_round_is_known(from_all_round):
    level = np.abs(POINTS[:, 1]) < 0.15
    assert from_all_round.ignorance[level].max() < 0.15
    assert from_all_round.unseen[level].max() < 0.2


def test_turning_is_the_spread_of_directions(from_front, from_all_round):
    assert from_front.turns().max() < 0.05  # degrees; directions are of single precision
    assert from_all_round.turns() == pytest.approx(45.0, abs=8.0)
    angles = [-0.4, 0.4]  # two looks, each so far from their axis
    turns = observe_surface(seen_from(angles), POINTS, FACES).turns()
    assert turns[nearest_vertex((0, 1, 0))] == pytest.approx(math.degrees(0.4), abs=1.5)


def test_ignorance_falls_as_looks_spread():
    front = nearest_vertex((0, 0, 1))
    found = [
        observe_surface(seen_from([-a, 0.0, a]), POINTS, FACES).ignorance[front]
        for a in (0.0, 0.1, 0.3, 0.6, 1.0)
    ]
    assert found == sorted(found, reverse=True) and found[0] > 0.99 and found[-1] < 0.15


def test_it_turns_with_the_surface(from_front):
    c, s = math.cos(0.7), math.sin(0.7)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.array(
        [[1, 0, 0], [0, c, -s], [0, s, c]]
    )
    turned = observe_surface(seen_from([0.0] * 10), POINTS @ turn.T, FACES)
    assert turned.ignorance == pytest.approx(from_front.ignorance, abs=1e-9)
    assert of_outlines(turned, *(turn @ [0.0, 0.6, 0.8])) == pytest.approx(
        of_outlines(from_front, 0.0, 0.6, 0.8), abs=1e-9
    )
