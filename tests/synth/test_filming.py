"""The levels `camera` and `wild`: light, lens, sensor and segmenter, and what their errors are in numbers."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest

from occfusion.synth import sensor
from occfusion.synth.lamps import LAMPS, Lamps, LitSurface, make_lamps, oren_nayar, seen_from
from occfusion.synth.scene import Scene
from occfusion.synth.segmenter import BUMP_WIDTH, EDGE_ERROR, LARGEST, LASTING, LONGEST, SHORTEST, Segmenter
from occfusion.synth.spec import SceneSpec

SMALL = {"image_size": 96, "frames": 6, "cameras": 3}


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    names = ("004-clean", "004-camera", "004-camera-boxes")
    return {name: Scene(replace(SceneSpec.parse(name), **SMALL)) for name in names}


def test_the_srgb_curve_is_that_of_the_standard() -> None:
    """Values of IEC 61966-2-1, and the way there and back."""
    known = {0.0: 0.0, 0.04045: 0.0031308, 0.5: 0.21404, 1.0: 1.0, 0.735357: 0.5}
    for encoded, linear in known.items():
        assert sensor.to_linear(np.array([encoded]))[0] == pytest.approx(linear, abs=2e-5)
        assert sensor.to_srgb(np.array([linear]))[0] == pytest.approx(encoded, abs=2e-5)
    np.testing.assert_allclose(sensor.to_srgb(np.array([-0.2, 1.7])), [0.0, 1.0], atol=1e-6)


def test_noise_has_the_spread_that_light_gives_it() -> None:
    rng = np.random.default_rng(0)
    for light in (0.02, 0.2, 0.6):
        flat = np.full((200, 200, 3), light, np.float32)
        found = sensor.to_linear(sensor.expose(flat, 1.0, rng) / 255.0)
        rounding = (sensor.to_linear(sensor.to_srgb(np.float32(light)) + 1 / 255) - light) / np.sqrt(12.0)
        wanted = np.sqrt(sensor.READ_NOISE**2 + sensor.SHOT_NOISE * light + float(rounding) ** 2)
        assert found.std() == pytest.approx(wanted, rel=0.06)
        assert found.mean() == pytest.approx(light, rel=0.01)


def test_the_exposure_takes_half_of_a_change_back() -> None:
    picture = np.full((40, 40, 3), 0.1, np.float32)
    first = sensor.metered(picture)
    assert first == pytest.approx(0.1)
    assert sensor.exposure(sensor.metered(4.0 * picture), first, 2.0) == pytest.approx(1.0)
    bright_middle, bright_corner = picture.copy(), picture.copy()
    bright_middle[16:24, 16:24] = 1.0
    bright_corner[:8, :8] = 1.0
    assert sensor.metered(bright_middle) > 2.0 * sensor.metered(bright_corner) - first > first


def test_rough_surfaces_send_more_back_to_the_lamp() -> None:
    """Oren and Nayar against a direct evaluation of their formula with angles; smooth ones are Lambert's."""
    rng = np.random.default_rng(1)
    normal = np.array([0.0, 0.0, 1.0])
    directions = rng.standard_normal((2, 50, 3))
    directions[..., 2] = np.abs(directions[..., 2]) + 0.1
    lamp, eye = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    lit, seen, between = lamp @ normal, eye @ normal, (lamp * eye).sum(axis=1)
    np.testing.assert_allclose(oren_nayar(lit, seen, between, 0.0), 1.0)
    sigma = 0.4
    light_angle, eye_angle = np.arccos(lit), np.arccos(seen)
    azimuth = np.arctan2(lamp[:, 1], lamp[:, 0]) - np.arctan2(eye[:, 1], eye[:, 0])
    a = 1.0 - 0.5 * sigma**2 / (sigma**2 + 0.33)
    b = 0.45 * sigma**2 / (sigma**2 + 0.09)
    larger, smaller = np.maximum(light_angle, eye_angle), np.minimum(light_angle, eye_angle)
    wanted = a + b * np.maximum(np.cos(azimuth), 0.0) * np.sin(larger) * np.tan(smaller)
    np.testing.assert_allclose(oren_nayar(lit, seen, between, sigma), wanted, atol=1e-9)


def test_highlights_lie_where_a_mirror_would_show_the_lamp() -> None:
    """On a ball the brightest highlight is where the normal halves the angle between lamp and camera."""
    rng = np.random.default_rng(2)
    normals = rng.standard_normal((4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lamp, eye = np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
    lamps = Lamps(lamp[None], np.array([[1.0, 0.5, 0.25]]), np.zeros(3), np.zeros(3))
    gloss = np.tile([30.0, 1.0], (4000, 1))
    ball = LitSurface(1e-3 * normals, normals, np.zeros((4000, 3)), np.ones((4000, 1)), gloss, np.ones(4000))
    diffuse, shine = seen_from(ball, lamps, 100.0 * eye)
    half = (lamp + eye) / np.linalg.norm(lamp + eye)
    assert np.degrees(np.arccos(normals[shine[:, 0].argmax()] @ half)) < 8.0
    dark = normals @ lamp <= 0.0
    assert not shine[dark].any() and not diffuse[dark].any()
    lit = ~dark
    np.testing.assert_allclose(shine[lit, 1], 0.5 * shine[lit, 0])  # highlights have the lamp's colour


def test_lamps_have_colours_and_sides_of_their_own() -> None:
    lamps = [make_lamps(np.random.default_rng(k)) for k in range(20)]
    for own in lamps:
        np.testing.assert_allclose(np.linalg.norm(own.towards, axis=1), 1.0)
        assert len(own.towards) == LAMPS and (own.towards[:, 2] > 0.2).all()
        hues = own.colours / own.colours.sum(axis=1, keepdims=True)
        assert all(np.abs(a - b).max() > 0.02 for a, b in itertools.combinations(hues, 2))
    assert np.std([own.towards[0] for own in lamps], axis=0).max() > 0.1


def test_a_segmenter_s_edge_has_its_spread_and_lasts() -> None:
    size, frames = 512, 200
    found = Segmenter(size, frames, np.random.default_rng(0))
    shifts = np.stack([found.edge_shift(k) for k in range(frames)])
    assert shifts.std() == pytest.approx(EDGE_ERROR, rel=0.05)
    flat = shifts.reshape(frames, -1)

    def alike(lag: int) -> float:
        return float((flat[lag:] * flat[: frames - lag]).mean() / (flat**2).mean())

    assert alike(1) > 0.9  # a frame later it is the same error
    assert alike(3) > 0.4
    assert abs(alike(round(4 * LASTING))) < 0.1
    neighbour = (shifts[:, 1:] * shifts[:, :-1]).mean() / (shifts**2).mean()
    assert abs(neighbour) < 0.1  # knots are independent: bumps are BUMP_WIDTH wide
    assert shifts.shape[1] == int(np.ceil(size / BUMP_WIDTH)) + 2


def test_a_segmenter_misses_hands_for_several_frames() -> None:
    found = [Segmenter(256, 300, np.random.default_rng(k)) for k in range(10)]
    events = [event for own in found for event in own.events]
    lengths = [event.last - event.first + 1 for event in events]
    assert min(lengths) == SHORTEST and max(lengths) == LONGEST
    assert 0.045 < len(events) / (10 * 300) < 0.08
    assert {event.sign for event in events} == {-1.0, 1.0}
    assert max(event.radius for event in events) <= LARGEST / 2
    # where one is, the edge is moved by more than edges are, and nowhere else
    own = found[0]
    event = next(e for e in own.events if e.first >= 0)
    part, place = (slice(0, 256), slice(0, 256)), np.array([100.5, 80.5])
    with_it = own.shift(event.first, part, lambda _: place)
    own.events = [e for e in own.events if e is not event]
    difference = with_it - own.shift(event.first, part, lambda _: place)
    assert difference[80, 100] == pytest.approx(2.0 * event.sign * event.radius, rel=1e-5)
    rows, columns = np.nonzero(difference)
    assert np.hypot(rows + 0.5 - 80.5, columns + 0.5 - 100.5).max() < event.radius


def test_bodies_cameras_and_motion_are_those_of_clean(scenes: dict[str, Scene]) -> None:
    clean, filmed = scenes["004-clean"], scenes["004-camera"]
    np.testing.assert_array_equal(clean.disk_take.poses, filmed.disk_take.poses)
    np.testing.assert_array_equal(clean.parameters(3).vertices, filmed.parameters(3).vertices)
    for ours, theirs in zip(clean.cameras, filmed.disk_cameras, strict=True):
        np.testing.assert_array_equal(ours.K, theirs.K)


def test_pictures_are_another_s_and_masks_nearly_the_same(scenes: dict[str, Scene]) -> None:
    overlaps, differences = [], []
    for clean, filmed in zip(scenes["004-clean"].shots(2), scenes["004-camera"].shots(2), strict=True):
        both, either = (clean.mask & filmed.mask).sum(), (clean.mask | filmed.mask).sum()
        overlaps.append(both / either)
        differences.append(np.abs(clean.image.astype(int) - filmed.image)[clean.mask & filmed.mask].mean())
    assert min(overlaps) > 0.85 and max(overlaps) < 0.999
    assert min(differences) > 5.0


def test_frames_may_be_made_in_any_order(scenes: dict[str, Scene]) -> None:
    again = Scene(replace(SceneSpec.parse("004-camera"), **SMALL))
    last = [shot.image for shot in again.shots(5)]
    for ours, theirs in zip(last, scenes["004-camera"].shots(5), strict=True):
        np.testing.assert_array_equal(ours, theirs.image)


def test_what_moves_is_blurred(scenes: dict[str, Scene]) -> None:
    """The share of pixels that are partly the person is larger where a limb is fast than with a short shutter."""
    filming = scenes["004-camera"]._filming
    assert filming is not None
    moment = filming._moment(3)
    speed = np.linalg.norm(moment.velocity, axis=1)
    assert speed.max() > 0.01  # metres a frame
    before, after = (filming._moment(k).surface.points for k in (2, 4))
    np.testing.assert_allclose(moment.velocity, 0.5 * (after - before), atol=1e-12)


def test_an_occluder_hides_and_exposure_is_one(scenes: dict[str, Scene]) -> None:
    for shot in scenes["004-camera-boxes"].shots(2):
        assert shot.image_complete is not None and shot.mask_complete is not None
        assert not (shot.mask & ~shot.mask_complete).any()
        inside = cv2.erode(shot.mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        assert np.abs(shot.image.astype(int) - shot.image_complete)[inside].mean() < 2.0
