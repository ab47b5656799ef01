"""Offsets between outlines: against ellipses worked out by hand, and on masks that have no outline."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates, sobel

from occfusion.geometry.outlines import STEP, _crossings, _gradient, outline_offsets

SIZE = 96
SAMPLES = 8


def ellipse(middle: tuple[float, float], axes: tuple[float, float], size: int = SIZE) -> np.ndarray:
    """Share of each pixel inside, by sampling 8 x 8 points of it."""
    places = (np.arange(size * SAMPLES) + 0.5) / SAMPLES
    x, y = (places - middle[0]) / axes[0], (places - middle[1]) / axes[1]
    inside = x[None, :] ** 2 + y[:, None] ** 2 < 1
    return inside.reshape(size, SAMPLES, size, SAMPLES).mean(axis=(1, 3))


def to_ellipse(points: np.ndarray, normals: np.ndarray, middle, axes) -> np.ndarray:
    """How far along each normal the ellipse is left: the larger root of a quadratic, point by point."""
    found = []
    for point, normal in zip(points, normals, strict=True):
        p, d = (point - middle) / axes, normal / np.array(axes)
        a, b, c = d @ d, 2 * p @ d, p @ p - 1
        found.append((-b + np.sqrt(b * b - 4 * a * c)) / (2 * a))
    return np.array(found)


@pytest.mark.parametrize(
    ("middle", "axes"),
    [((48.0, 48.0), (30.0, 20.0)), ((48.4, 47.7), (31.0, 21.5)), ((47.1, 49.3), (28.0, 19.0))],
)
def test_offsets_are_those_of_two_ellipses(middle, axes):
    first = ellipse((48.0, 48.0), (30.0, 20.0))
    found = outline_offsets(first, ellipse(middle, axes) > 0.5, 6.0)
    true = to_ellipse(found.points, found.normals, np.array(middle), axes)
    assert len(found.offsets) > 120
    # a binary mask knows an edge to a fraction of a pixel, and many pixels to a hundredth
    assert np.abs(found.offsets - true).max() < 0.45
    assert abs(np.mean(found.offsets - true)) < 0.04


def test_crossings_and_gradients_are_those_of_a_picture_that_is_sampled_point_by_point():
    """Samples by SciPy; of all falls through one half, the nearest, looked for one after the other."""
    rng = np.random.default_rng(0)
    image = gaussian_filter(rng.uniform(size=(40, 30)), 1.5).astype(np.float32)
    image = (image - image.min()) / np.ptp(image)
    points = rng.uniform(-3.0, 43.0, (300, 2))  # some beyond the border
    angles = rng.uniform(0.0, 2 * np.pi, 300)
    normals, near = np.stack([np.cos(angles), np.sin(angles)], axis=1), rng.uniform(-3.0, 3.0, 300)

    def at(picture, places):
        return map_coordinates(picture.astype(np.float64), (places[:, ::-1] - 0.5).T, order=1, mode="nearest")

    found, reach = _crossings(image, points, normals, 5.1, near), 5.25  # whole steps
    for k, (point, normal) in enumerate(zip(points, normals, strict=True)):
        distances = np.arange(-reach, reach + 0.5 * STEP, STEP)
        profile = at(image, point + distances[:, None] * normal)
        falls = [
            distances[n] + STEP * (profile[n] - 0.5) / (profile[n] - profile[n + 1])
            for n in range(len(profile) - 1)
            if profile[n] >= 0.5 > profile[n + 1]
        ]
        wanted = min(falls, key=lambda place: abs(place - near[k]), default=np.nan)
        np.testing.assert_allclose(found[k], wanted, atol=1e-5)
    assert 0.3 < np.isfinite(found).mean() < 1.0
    inside = ((points > 2) & (points < [28, 38])).all(axis=1)
    gradient = np.stack([at(sobel(image.astype(float), axis), points) for axis in (1, 0)], axis=1)
    np.testing.assert_allclose(_gradient(image, points)[inside], gradient[inside], atol=1e-5)


def test_the_points_lie_on_the_first_outline_and_normals_point_out():
    found = outline_offsets(ellipse((48, 48), (30, 20)), ellipse((48, 48), (32, 22)) > 0.5, 6.0)
    local = (found.points - 48) / (30, 20)
    assert np.abs(np.linalg.norm(local, axis=1) - 1).max() < 0.02
    outward = local / (30, 20)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert (found.normals * outward).sum(axis=1).min() > 0.97
    assert (found.pixels == np.floor(found.points)[:, ::-1]).mean() > 0.5


def test_the_mean_shift_is_found_to_a_hundredth():
    first = ellipse((48, 48), (30, 20))
    found = outline_offsets(first, ellipse((48.5, 47.75), (30, 20)) > 0.5, 6.0)
    shift = np.linalg.lstsq(found.normals, found.offsets, rcond=None)[0]
    np.testing.assert_allclose(shift, (0.5, -0.25), atol=0.03)


def test_whole_pixels_change_nothing():
    a, b = ellipse((40, 44), (22, 17)), ellipse((41, 44.5), (23, 18)) > 0.5
    first, moved = (
        outline_offsets(x, y, 5.0) for x, y in ((a, b), (np.roll(a, 7, axis=1), np.roll(b, 7, axis=1)))
    )
    np.testing.assert_allclose(
        moved.points - first.points, np.tile((7.0, 0.0), (len(first.points), 1)), atol=1e-4
    )
    np.testing.assert_allclose(moved.offsets, first.offsets, atol=1e-4)


def test_the_edge_of_an_occluder_is_not_taken_for_the_outline():
    first, seen = ellipse((48, 48), (30, 20)), ellipse((48, 48), (31, 21)) > 0.5
    seen[:, 40:60] = False  # a pole before the person
    found = outline_offsets(first, seen, 5.0)
    # above and below, outlines run along the pole's ends and not across it
    assert not ((found.points[:, 0] > 42) & (found.points[:, 0] < 58)).any()
    assert np.median(found.offsets) == pytest.approx(1.0, abs=0.1)


@pytest.mark.stiff
@pytest.mark.parametrize(
    ("first", "second"),
    [
        (np.zeros((8, 8)), np.zeros((8, 8), bool)),
        (np.ones((8, 8)), np.ones((8, 8), bool)),
        (np.ones((8, 8)), np.zeros((8, 8), bool)),
        (np.zeros((8, 8)), np.ones((8, 8), bool)),
        (np.eye(8), np.eye(8, dtype=bool)),
        (np.ones((1, 1)), np.ones((1, 1), bool)),
        (np.full((1, 40), 0.6), np.ones((1, 40), bool)),
    ],
)
def test_masks_without_an_outline_give_no_or_finite_offsets(first, second):
    found = outline_offsets(first, second, 3.0)
    assert all(np.isfinite(part).all() for part in found)
    assert np.abs(found.offsets).max(initial=0.0) <= 3.0 + 2.0


@pytest.mark.stiff
def test_a_long_outline_is_sampled_in_pieces():
    stripes = np.zeros((1400, 1400))
    stripes[::28] = stripes[1::28] = stripes[2::28] = stripes[3::28] = 1.0
    found = outline_offsets(stripes, stripes > 0.5, 2.0)
    assert len(found.offsets) > 60_000
    assert np.abs(found.offsets).max() < 1e-3


def strip(angle: float, size: int = 256) -> np.ndarray:
    """A half plane through the middle, whose edge has this direction."""
    y, x = np.mgrid[:size, :size] + 0.5 - 0.5 * size
    return (x * np.sin(angle) - y * np.cos(angle) < 0.25).astype(float)


@pytest.mark.parametrize("angle", [0.0, 90.0, 45.0, 135.0, 26.565, 63.435, 18.435, 7.0, 200.0, 331.0])
@pytest.mark.parametrize("least", [150, 1])
def test_of_a_long_outline_some_points_are_taken_evenly_whatever_its_direction(angle, least):
    """150 where two in five are fewer, else two in five."""
    mask = strip(np.radians(angle))
    every, some = (outline_offsets(mask, mask > 0.5, 6.0, few) for few in (None, least))
    wanted = max(least, 0.4 * len(every.offsets))
    assert 0.85 * wanted <= len(some.offsets) <= 1.15 * wanted
    along = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    whole, taken = (np.sort(found.points @ along) for found in (every, some))
    gaps = np.diff(np.concatenate([whole[:1], taken, whole[-1:]]))
    assert gaps.max() < 4.0 * (whole[-1] - whole[0]) / len(taken)


def test_points_that_are_taken_are_what_they_are_among_all():
    first, second = ellipse((48, 48), (30, 20)), ellipse((48.4, 47.7), (31, 21)) > 0.5
    every, some = (outline_offsets(first, second, 6.0, few) for few in (None, 40))
    places = {tuple(pixel): k for k, pixel in enumerate(every.pixels)}
    own = [places[tuple(pixel)] for pixel in some.pixels]
    assert 0.3 * len(places) <= len(own) <= 0.5 * len(places) and len(set(own)) == len(own)
    for found, among in zip(some, every, strict=True):
        np.testing.assert_array_equal(found, among[own])
    for found, among in zip(outline_offsets(first, second, 6.0, 1000), every, strict=True):
        np.testing.assert_array_equal(found, among)
