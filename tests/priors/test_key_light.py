"""The lamp that a video shows: made-up sightings with a known one, a general optimiser as oracle, embedded people."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from occfusion.observation.key_light import STRONGEST, KeyLight, fit_key_light
from occfusion.observation.sightings import POINTS, Sightings, join

LAMP = np.array([0.12, -0.2, 0.15])


def people(
    lamp: NDArray[np.float64] = LAMP,
    *,
    noise: float = 0.0,
    outliers: float = 0.0,
    turn: float = 2.5,
    points: int = 400,
    frames: int = 30,
    seed: int = 0,
) -> Sightings:
    """Points of a ball that turns about z and nods, seen by a camera at -y; `turn` in radians."""
    generator = np.random.default_rng(seed)
    own = generator.uniform(0.1, 0.8, (points, 3))
    rest = generator.normal(size=(points, 3))
    rest /= np.linalg.norm(rest, axis=1, keepdims=True)
    parts = []
    for frame, k in enumerate(np.linspace(-1.0, 1.0, frames)):
        a, b = turn * k, 0.4 * turn * np.sin(3.0 * k)
        about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
        normals = rest @ (about_x @ about_z).T
        seen = np.flatnonzero(normals[:, 1] < -0.2)
        colors = own[seen] * (1.0 + np.maximum(normals[seen] @ lamp, 0.0))[:, None]
        colors = colors + noise * generator.normal(size=colors.shape)
        wrong = generator.uniform(size=len(seen)) < outliers
        colors[wrong] = generator.uniform(0, 1, (int(wrong.sum()), 3))
        parts.append(Sightings(seen, colors, normals[seen], np.full(len(seen), frame)))
    return join(parts)


def found(sightings: Sightings) -> KeyLight:
    lamp = fit_key_light(sightings)
    assert lamp is not None
    return lamp


@pytest.mark.parametrize(
    "lamp", [LAMP, 8 * LAMP, -LAMP, np.array([0.0, 0.0, 0.3]), np.array([0.3, 0.0, 0.0])]
)
def test_a_known_lamp_is_found(lamp: NDArray[np.float64]) -> None:
    light = found(people(lamp))
    assert np.abs(light.vector - lamp).max() < 2e-3 * np.linalg.norm(lamp)
    assert light.explained > 0.95
    assert light.condition < 50


def test_noise_and_observations_of_something_else_move_it_little() -> None:
    light = found(people(noise=0.01, outliers=0.2))
    assert np.linalg.norm(light.vector - LAMP) < 0.1 * np.linalg.norm(LAMP)
    assert light.explained > 0.2


def test_it_is_where_a_general_optimiser_ends() -> None:
    """SciPy on all unknowns at once, each point's colour among them, without robust weights: no outliers here."""
    sightings = people(noise=0.002, points=320, frames=12)
    points = np.unique(sightings.points, return_inverse=True)[1]
    count = points.max() + 1

    def residual(x: NDArray[np.float64]) -> NDArray[np.float64]:
        own = x[3:].reshape(count, 3)
        light = 1.0 + np.maximum(sightings.normals @ x[:3], 0.0)
        return np.asarray((sightings.colors - own[points] * light[:, None]).ravel())

    def jacobian(x: NDArray[np.float64]) -> object:
        from scipy.sparse import csr_matrix

        own = x[3:].reshape(count, 3)
        facing = sightings.normals @ x[:3]
        light, lit = 1.0 + np.maximum(facing, 0.0), sightings.normals * (facing > 0)[:, None]
        rows = np.arange(3 * len(points)).reshape(-1, 3)
        to_lamp = -own[points][:, :, None] * lit[:, None, :]
        columns = np.broadcast_to(np.arange(3), (len(points), 3, 3))
        entries = [
            (to_lamp.ravel(), np.repeat(rows.ravel(), 3), columns.ravel()),
            (np.repeat(-light, 3), rows.ravel(), (3 + 3 * points[:, None] + np.arange(3)).ravel()),
        ]
        values, at_rows, at_columns = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        return csr_matrix((values, (at_rows, at_columns)), shape=(3 * len(points), len(x)))

    start = np.concatenate([[0.05, -0.05, 0.05], np.full(3 * count, 0.4)])
    expected = least_squares(residual, start, jac=jacobian, xtol=1e-12, ftol=1e-12).x[:3]
    assert np.linalg.norm(found(sightings).vector - expected) < 0.02 * np.linalg.norm(expected)


def test_turning_the_world_turns_the_lamp_and_brighter_colours_leave_it() -> None:
    sightings = people(noise=0.005)
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    turned = replace(sightings, colors=0.5 * sightings.colors, normals=sightings.normals @ turn.T)
    assert np.abs(found(turned).vector - turn @ found(sightings).vector).max() < 1e-3


def test_even_light_explains_nothing() -> None:
    light = fit_key_light(people(np.zeros(3), noise=0.01))
    assert light is None or light.explained < 0.02


def test_who_never_turns_does_not_tell() -> None:
    light = fit_key_light(people(turn=0.0, noise=0.01))
    assert light is None or light.explained < 0.02 or light.condition > 50


@pytest.mark.parametrize("colors", [0.0, 1.0])
def test_one_colour_everywhere_tells_nothing(colors: float) -> None:
    sightings = people()
    flat = replace(sightings, colors=np.full_like(sightings.colors, colors))
    assert fit_key_light(flat) is None


def test_few_points_and_few_sightings_tell_nothing() -> None:
    assert fit_key_light(people(points=POINTS // 4)) is None
    assert fit_key_light(people(frames=4)) is None
    none = np.zeros(0, np.int64)
    empty = Sightings(none, np.zeros((0, 3)), np.zeros((0, 3)), none)
    assert fit_key_light(join([empty, empty])) is None


def test_a_lamp_in_the_dark_is_bounded() -> None:
    light = fit_key_light(people(1e3 * LAMP))
    assert light is not None
    assert np.linalg.norm(light.vector) <= STRONGEST * (1 + 1e-9)
    assert light.vector @ LAMP > 0.9 * np.linalg.norm(light.vector) * np.linalg.norm(LAMP)
