"""A shift and a scale of pictures against cameras: found where they were put, and not where they were not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import torch

from occfusion.data import registration
from occfusion.data.outline_offsets import Correction, Offsets, View, measure_offsets
from occfusion.data.registration import agreement, register
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.zbuffer import rasterize_mesh
from occfusion.human import embedded_body
from occfusion.types import Camera

SIZE, FRAMES = 144, 30


@pytest.fixture(scope="module")
def body():
    return embedded_body()


@pytest.fixture(scope="module")
def faces(body) -> np.ndarray:
    return body.faces.numpy().astype(np.int64)


@pytest.fixture(scope="module")
def rest(body) -> np.ndarray:
    return body.v_template.double().numpy()


def camera(size: int = SIZE) -> Camera:
    viewmat = torch.eye(4)
    viewmat[1, 1] = viewmat[2, 2] = -1.0  # y up, the camera looks along -z
    viewmat[:3, 3] = torch.tensor([0.0, -0.25, 3.0])
    K = torch.tensor([[1.25 * size, 0, 0.5 * size], [0, 1.25 * size, 0.5 * size], [0, 0, 1]])
    return Camera(viewmat, K, size, size)


def moved(body, frame: int, turns: bool) -> np.ndarray:
    """A person who walks on the spot and waves, and turns round or does not."""
    phase = 2 * np.pi * frame / FRAMES
    pose = torch.zeros(23, 3)
    swing = 0.5 * np.sin(3 * phase)
    pose[0, 0], pose[1, 0] = swing, -swing  # hips
    pose[15, 2], pose[16, 2] = -0.7 + 0.5 * np.sin(2 * phase), 0.7 + 0.5 * np.cos(2 * phase)  # shoulders
    orient = torch.tensor([0.0, phase if turns else 0.1 * np.sin(phase), 0.0])
    transl = torch.tensor([0.25 * np.sin(phase), 0.0, 0.15 * np.cos(phase)])
    with torch.no_grad():
        vertices, _ = body(torch.zeros(10), orient, pose.flatten(), transl)
    return vertices.double().numpy()


def shown(vertices: np.ndarray, faces: np.ndarray, seen_by: Camera, samples: int = 4) -> np.ndarray:
    K = seen_by.K.double().numpy()
    view = seen_by.viewmat.double().numpy()
    local = vertices @ view[:3, :3].T + view[:3, 3]
    pixels = local[:, :2] / local[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    size = seen_by.width
    depth = rasterize_mesh(samples * pixels, local[:, 2], faces, samples * size, samples * size).depth
    return np.isfinite(depth).reshape(size, samples, size, samples).mean(axis=(1, 3)) > 0.5


def clothes(rest: np.ndarray) -> np.ndarray:
    """Metres: thick and thin places, hair on top, soles below."""
    waves = 0.008 + 0.006 * np.sin(rest @ np.array([9.0, 7.0, 8.0]))
    top, low = rest[:, 1].max(), rest[:, 1].min()
    return waves + 0.02 * (rest[:, 1] > top - 0.12) + 0.012 * (rest[:, 1] < low + 0.06)


def footage(
    body, faces, rest, true: Correction, *, turns: bool = True, hidden: float = 0.0, dressed: bool = True
):
    """Views whose cameras lack `true`."""
    views = []
    for frame in range(FRAMES):
        vertices = moved(body, frame, turns)
        surface = vertices + (clothes(rest)[:, None] * vertex_normals(vertices, faces) if dressed else 0.0)
        mask = shown(surface, faces, true.corrected(camera()))
        if hidden and frame < 0.8 * FRAMES:
            columns = np.flatnonzero(mask.any(axis=0))
            middle, half = columns.mean(), 0.5 * hidden * np.ptp(columns)
            mask[:, round(middle - half) : round(middle + half)] = False
        views.append(View(frame, vertices, camera(), mask))
    return views


@pytest.fixture(scope="module")
def film(body, faces, rest):
    """`footage`, each made once."""
    return cache(partial(footage, body, faces, rest))


def test_exact_pictures_are_left_alone(film, faces, rest):
    found = register(film(Correction(), dressed=False), faces, rest)
    np.testing.assert_allclose(found.shift, (0, 0), atol=0.02)
    assert abs(found.scale) < 2e-4 and found.correction.is_none


@pytest.mark.parametrize(
    ("true", "hidden"),
    [
        (Correction((0.5, 0.5)), 0.0),
        (Correction((-1.0, 0.6)), 0.5),
        (Correction((0.0, 0.0), 0.01), 0.0),
        (Correction((0.7, -0.5), -0.012), 0.5),
    ],
)
def test_what_cameras_lack_is_found_under_clothes(film, faces, rest, true, hidden):
    found = register(film(true, hidden=hidden), faces, rest)
    np.testing.assert_allclose(found.shift, true.shift, atol=0.13)
    assert found.scale == pytest.approx(true.scale, abs=2e-3)
    assert not found.correction.is_none
    left = np.subtract(found.correction.shift, true.shift)
    assert np.abs(left).max() < 0.13 and abs(found.correction.scale - true.scale) < 2.5e-3


def test_clothes_alone_are_no_shift(film, faces, rest):
    for turns in (True, False):
        found = register(film(Correction(), turns=turns), faces, rest)
        assert found.correction.is_none, found.text()


def test_who_does_not_turn_leaves_more_open(film, faces, rest):
    """Hair on top and soles below are a shift of nothing only to somebody who sees the person from more sides."""
    turning, still = (register(film(Correction(), turns=turns), faces, rest) for turns in (True, False))
    assert np.all(np.array(still.shift_error) > turning.shift_error)


def test_a_shift_far_beyond_the_clothes_is_followed(film, faces, rest):
    true = Correction((7.0, -5.0))
    found = register(film(true), faces, rest)
    np.testing.assert_allclose(found.shift, true.shift, atol=0.15)


def test_shifting_pictures_shifts_the_answer(film, faces, rest):
    views = film(Correction())
    before = register(views, faces, rest)
    after = register([replace(v, mask=np.roll(v.mask, 3, axis=1)) for v in views], faces, rest)
    assert after.shift[0] - before.shift[0] == pytest.approx(3.0, abs=0.02)
    assert after.shift[1] - before.shift[1] == pytest.approx(0.0, abs=0.02)


def test_other_cameras_say_whether_they_need_it_too(film, faces, rest):
    true = Correction((0.6, -0.4))
    for there, wanted in ((true, 1.0), (Correction(), 0.0)):
        views = [replace(v, group=k % 4) for k, v in enumerate(film(there))]
        share, error = agreement(views, [true] * len(views), faces, rest)
        assert share == pytest.approx(wanted, abs=0.15) and 0 < error < 0.2


def test_the_robust_fit_is_at_the_bottom_of_its_cost(film, faces, rest):
    """Oracle: the cost as it is written, by loops over points; its gradient by differences is zero at the answer."""
    views = film(Correction((0.3, 0.2)))[::6]
    data = measure_offsets(views, faces, Correction())
    keep = np.arange(0, len(data), 17)
    names = ("fields", "moves", "offsets", "vertices", "pixels_per_metre", "groups")
    few = Offsets(*(getattr(data, name)[keep] for name in names), data.size)
    places = tuple(registration._nearest(rest, count) for count in (3, 7))
    fit = registration._Fit(few, places)
    normal = fit._normal + np.diag(fit._prior)
    answer = np.linalg.solve(normal, fit._right)

    def modelled(values: np.ndarray) -> np.ndarray:
        out = np.zeros(len(few))
        for i in range(len(few)):
            v, metre = few.vertices[i], few.pixels_per_metre[i]
            stands_off = values[3] + values[4 + places[0][v]] + values[4 + 3 + places[1][v]]
            out[i] = few.fields[i] @ values[:3] + metre * stands_off
        return out

    residual = few.offsets - modelled(answer)
    noise = max(1.4826 * np.median(np.abs(residual)), registration.LEAST_NOISE)
    bound = registration.BIWEIGHT * noise

    def cost(values: np.ndarray) -> float:
        left = few.offsets - modelled(values)
        biweight = np.where(np.abs(left) < bound, 1 - (1 - (left / bound) ** 2) ** 3, 1.0) * bound**2 / 6
        spread = [registration.MEAN_STANDS_OFF] + [registration.STANDS_OFF] * 10
        prior = 0.5 * sum((value / s) ** 2 for value, s in zip(values[3:], spread, strict=True))
        return float(biweight.sum() / (registration.CORRELATED * noise**2) + prior)

    steps = np.array([1e-3] * 2 + [1e-5] + [1e-5] * 11)
    for k, step in enumerate(steps):
        shift = np.eye(len(steps))[k] * step
        slope = (cost(answer + shift) - cost(answer - shift)) / (2 * step)
        # in units of the answer's own error
        assert abs(slope) / np.sqrt(normal[k, k]) < 0.05, k


@pytest.mark.stiff
def test_too_little_is_said_to_be_too_little(film, faces, rest):
    views = film(Correction())
    assert register(views[:2], faces, rest) is None
    nobody = [replace(view, mask=np.zeros_like(view.mask)) for view in views]
    assert register(nobody, faces, rest) is None
    behind = [replace(view, vertices=view.vertices + np.array([0, 0, 10.0])) for view in views]
    assert register(behind, faces, rest) is None
    aside = [replace(view, vertices=view.vertices + np.array([9.0, 0, 0])) for view in views]
    assert register(aside, faces, rest) is None
    assert register([], faces, rest) is None


@pytest.mark.stiff
def test_masks_of_everything_and_of_noise_correct_nothing(film, faces, rest):
    views = film(Correction())
    everything = [replace(view, mask=np.ones_like(view.mask)) for view in views]
    assert register(everything, faces, rest) is None
    rng = np.random.default_rng(0)
    noise = [replace(view, mask=rng.random(view.mask.shape) < 0.5) for view in views]
    found = register(noise, faces, rest)
    assert found is None or found.correction.is_none


def test_corrections_scale_with_the_picture():
    found = Correction((1.0, -2.0), 0.01).resized(0.5)
    assert found == Correction((0.5, -1.0), 0.01)
    changed = found.corrected(camera())
    K = camera().K
    torch.testing.assert_close(changed.K[:2, 2], K[:2, 2] + torch.tensor([0.5, -1.0]))
    torch.testing.assert_close(changed.K[0, 0], K[0, 0] * 1.01)
    assert Correction().corrected(camera()).K.equal(K)


def from_sides(body, faces, rest, lack: Correction, misplaced: np.ndarray, sides: int) -> list[View]:
    """Views of cameras around the person; cameras lack something, or the body lies elsewhere than it is said to."""
    views = []
    for k in range(24):
        side = k % sides
        turn = np.eye(4)
        angle = 2 * np.pi * side / 8
        turn[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)
        seen_by = replace(camera(), viewmat=(camera().viewmat.double() @ torch.from_numpy(turn)).float())
        vertices = moved(body, k, turns=True)
        surface = vertices + clothes(rest)[:, None] * vertex_normals(vertices, faces) + misplaced
        views.append(View(side, vertices, seen_by, shown(surface, faces, lack.corrected(seen_by))))
    return views


@pytest.mark.parametrize(
    ("lack", "misplaced", "sides", "confirmed"),
    [
        (Correction((0.6, 0.0)), (0.0, 0.0, 0.0), 8, True),
        (Correction(), (0.012, 0.0, 0.0), 8, False),
        (Correction(), (0.0, 0.015, 0.0), 8, False),
        (Correction(), (0.012, 0.0, 0.0), 1, False),  # a camera at the same place sees the same
    ],
)
def test_a_body_elsewhere_is_no_confirmation(body, faces, rest, lack, misplaced, sides, confirmed):
    suspected = Correction((0.6, 0.0)) if misplaced[1] == 0 else Correction((0.0, -0.9))
    views = from_sides(body, faces, rest, lack, np.array(misplaced), sides)
    share, error = agreement(views, [suspected] * len(views), faces, rest, or_misplaced=True)
    assert (share >= 0.5 and share >= 4 * error) == confirmed, (share, error)
