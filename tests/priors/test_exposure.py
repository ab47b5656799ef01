"""How exposure wanders: made-up sightings with known gains, a general optimiser as oracle, what halves agree on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from occfusion.observation.exposure import WORTH, Exposure, Gains, fit_gains, gain_of, judge
from occfusion.observation.light import disagreement, fit_light
from occfusion.observation.sightings import Sightings, join
from priors.test_key_light import LAMP, people

FRAMES = 30


def wandering(amount: float, seed: int = 3) -> NDArray[np.float64]:
    """Logarithms of gains, `[F, 3]`, whose means are 0."""
    logs = amount * np.random.default_rng(seed).normal(size=(FRAMES, 3))
    return np.asarray(logs - logs.mean(axis=0))


def under(logs: NDArray[np.float64], **how: float | int) -> Sightings:
    """People that are filmed with these gains; dark enough that hardly anything clips."""
    seen = people(**how)  # type: ignore[arg-type]
    return replace(seen, colors=0.5 * seen.colors * np.exp(logs)[seen.frames])


def found(seen: Sightings, vector: NDArray[np.float64] = LAMP) -> Gains:
    gains = fit_gains(seen, vector)
    assert gains is not None
    return gains


def judged(seen: Sightings) -> Exposure:
    return judge(seen, found(seen))


@pytest.mark.parametrize("amount", [0.02, 0.3])
def test_known_gains_are_found(amount: float) -> None:
    logs = wandering(amount)
    gains = found(under(logs))
    assert gains.positions.tolist() == [*range(FRAMES)]
    assert np.abs(gains.logs - logs).max() < 0.02 * amount


def test_noise_and_observations_of_something_else_move_them_little() -> None:
    logs = wandering(0.1)
    gains = found(under(logs, noise=0.02, outliers=0.2))
    assert np.std(gains.logs - logs) < 0.01


def test_they_are_where_a_general_optimiser_ends() -> None:
    """SciPy on all gains, each point's own colour the best for them by its own regression, without robust weights."""
    seen = under(wandering(0.1), noise=0.002, points=300)
    points = np.unique(seen.points, return_inverse=True)[1]
    light = 1.0 + np.maximum(seen.normals @ LAMP, 0.0)

    def residual(logs: NDArray[np.float64]) -> NDArray[np.float64]:
        bright = light * np.exp(logs)[seen.frames]
        left = np.empty(len(points))
        for point in range(points.max() + 1):
            rows = points == point
            own = bright[rows] @ red[rows] / (bright[rows] @ bright[rows])
            left[rows] = red[rows] - own * bright[rows]
        return left

    red = seen.colors[:, 0]
    expected = least_squares(residual, np.zeros(FRAMES), xtol=1e-10).x
    assert np.abs(found(seen).logs[:, 0] - (expected - expected.mean())).max() < 1e-3


def test_nothing_is_better_nearby() -> None:
    """A gradient check: the robust error of the end, by central differences."""
    seen = under(wandering(0.1), noise=0.01)
    gains = found(seen)
    own = gains.colors[np.searchsorted(gains.points, seen.points)]
    light = 1.0 + np.maximum(seen.normals @ LAMP, 0.0)[:, None]
    scale = 2.0 * gains.usual

    def error(logs: NDArray[np.float64]) -> float:
        squared = (((seen.colors - own * light * np.exp(logs)[seen.frames]) / scale) ** 2).sum(axis=1)
        return float((squared / (1.0 + squared)).mean())

    least = error(gains.logs)
    for frame in (0, 7, 29):
        step = np.zeros((FRAMES, 3))
        step[frame] = 1e-2
        assert min(error(gains.logs + step), error(gains.logs - step)) > least


def test_a_brighter_frame_is_found_brighter_and_brighter_people_change_nothing() -> None:
    seen = under(wandering(0.05), noise=0.005)
    brighter = replace(seen, colors=0.5 * seen.colors)
    assert np.abs(found(brighter).logs - found(seen).logs).max() < 1e-3
    louder = np.where((seen.frames == 4)[:, None], 1.2 * seen.colors, seen.colors)
    change = found(replace(seen, colors=louder)).logs - found(seen).logs
    change -= np.median(change, axis=0)
    assert np.abs(change[4] - np.log(1.2)).max() < 2e-3
    assert np.abs(np.delete(change, 4, axis=0)).max() < 2e-3


def test_a_frame_that_was_not_looked_at_is_given_the_same() -> None:
    logs = wandering(0.1)
    seen = under(logs, noise=0.005)
    all_gains = found(seen)
    is_odd = seen.frames % 2 == 1
    even = found(seen.of(~is_odd))
    for frame in (1, 15):
        rows = seen.frames == frame
        own = Sightings(seen.points[rows], seen.colors[rows], seen.normals[rows], seen.frames[rows])
        offset = even.logs[0] - all_gains.logs[0]
        assert np.abs(gain_of(own, even) - offset - all_gains.logs[frame]).max() < 0.01
    nothing = np.zeros(0, np.int64)
    assert (gain_of(Sightings(nothing, np.zeros((0, 3)), np.zeros((0, 3)), nothing), even) == 0.0).all()


def test_two_halves_agree_on_exposure_and_not_on_noise() -> None:
    shaken = judged(under(wandering(0.05), noise=0.005, points=800))
    assert shaken.is_taken and (shaken.trust > 0.95).all() and abs(shaken.spread - 0.05) < 0.01
    still = judged(under(wandering(0.0), noise=0.05, points=800))
    assert not still.is_taken and still.spread < 0.01 and still.explained < 0.2 * WORTH
    assert np.abs(still.evened(still.gains.logs) - 1.0).max() < np.abs(np.exp(still.gains.logs) - 1.0).max()


def test_a_half_that_tells_nothing_is_not_trusted() -> None:
    assert not judged(
        under(wandering(0.05), points=350)
    ).is_taken  # either half has fewer points than tell of light


@pytest.mark.stiff
@pytest.mark.parametrize("level", [0.0, 1e-6, 1.0, 1e3])
def test_black_and_clipped_pictures_leave_finite_gains(level: float) -> None:
    seen = people(frames=FRAMES)
    flat = replace(seen, colors=np.full_like(seen.colors, level))
    assert np.abs(found(flat, np.zeros(3)).logs).max() < 1e-6


@pytest.mark.stiff
def test_a_frame_that_shows_one_point_stays_near_the_others() -> None:
    seen = under(wandering(0.02), noise=0.02)
    keep = (seen.frames != 9) | (np.cumsum(seen.frames == 9) == 1)
    assert np.abs(found(seen.of(keep)).logs).max() < 0.5


def test_few_points_tell_nothing() -> None:
    seen = people(points=40)
    assert fit_gains(seen, LAMP) is None
    light = fit_light(join([seen]), even=True)
    assert (light.key_light, light.exposure, light.gains) == (None, None, None)


@pytest.mark.parametrize("amount", [0.0, 0.05, 0.2])
def test_a_lamp_is_found_whatever_the_exposure(amount: float) -> None:
    """With the exposure known it explains as much as under a steady one; alone it explains next to nothing."""
    light = fit_light(under(wandering(amount), noise=0.005, points=800), even=True)
    assert light.key_light is not None and light.exposure is not None
    assert light.exposure.is_taken == (amount > 0.0)
    assert np.linalg.norm(light.key_light.vector - LAMP) < 0.05 * np.linalg.norm(LAMP)
    assert light.disagreement < 0.1 and light.key_light.explained > 0.3
    if amount > 0.1:
        alone = fit_light(under(wandering(amount), noise=0.005, points=800), even=False).key_light
        assert alone is None or alone.explained < 0.1


@pytest.mark.parametrize("noise", [0.005, 0.05])
def test_two_halves_disagree_on_a_lamp_that_is_not_there(noise: float) -> None:
    apart = [
        fit_light(people(np.zeros(3), noise=noise, points=800, seed=seed), even=False).disagreement
        for seed in range(4)
    ]
    assert min(apart) > 0.5
    lit = fit_light(people(LAMP, noise=noise, points=800), even=False)
    assert lit.disagreement < 0.25


def test_the_distance_of_two_lamps() -> None:
    lamp = fit_light(people(), even=False).key_light
    assert lamp is not None
    assert disagreement([lamp, None]) == float("inf")
    assert disagreement([lamp, lamp]) == 0.0
    assert disagreement([lamp, replace(lamp, vector=-lamp.vector)]) > 1e6


def test_thinned_sightings_tell_by_halves() -> None:
    many = people(points=4000)
    few = many.thinned(1000)
    assert len(few.points) < 0.3 * len(many.points)
    assert all(half.numbered() is not None for half in few.halves())
    assert np.isin(few.points, many.points).all()
    assert len(people().thinned(1000).points) == len(people().points)  # of 400 points none can be spared
