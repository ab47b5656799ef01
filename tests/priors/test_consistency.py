"""Warping along the body's motion: exact for a body that only moves."""

import numpy as np
import pytest

from occfusion.observation.consistency import ProjectedMesh, body_flow, smoothed, warp, warped_iou

SIZE = 80
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def square(x: float, y: float, side: float = 30.0) -> ProjectedMesh:
    corners = np.array([[0, 0], [side, 0], [side, side], [0, side]], float) + np.array([x, y])
    return ProjectedMesh(corners, np.full(4, 2.0))


def drawn(x: int, y: int, side: int = 30) -> np.ndarray:
    mask = np.zeros((SIZE, SIZE), bool)
    mask[y : y + side, x : x + side] = True
    return mask


@pytest.mark.parametrize("shift", [(0, 0), (5, 0), (-7, 4), (12, 11)])
def test_a_moved_mask_comes_back_exactly(shift: tuple[int, int]) -> None:
    flow = body_flow(square(20, 20), square(20 + shift[0], 20 + shift[1]), FACES, SIZE, SIZE)
    carried = warp(drawn(20 + shift[0], 20 + shift[1]).astype(np.float32), flow) > 0.5
    assert (carried == drawn(20, 20)).mean() > 0.999
    everywhere = np.ones((SIZE, SIZE), bool)
    assert warped_iou(drawn(20, 20), drawn(20 + shift[0], 20 + shift[1]), flow, everywhere) > 0.99


def test_flow_on_the_body_interpolates_its_motion() -> None:
    now, other = square(20, 20), square(20, 20)
    other.pixels[1:3, 0] += 6.0  # stretched to the right
    flow = body_flow(now, other, FACES, SIZE, SIZE)
    grid = np.stack(np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5), axis=-1)
    shift = (flow - grid)[35]
    assert shift[21, 0] < 1.0
    assert shift[48, 0] == pytest.approx(6.0 * (48.5 - 20) / 30, abs=0.3)
    assert abs(shift[:, 1]).max() < 1e-3


def test_body_that_is_not_seen_does_not_move_anything() -> None:
    behind = ProjectedMesh(square(20, 20).pixels, np.full(4, -1.0))
    flow = body_flow(behind, square(50, 50), FACES, SIZE, SIZE)
    picture = np.random.default_rng(0).random((SIZE, SIZE)).astype(np.float32)
    assert np.allclose(warp(picture, flow), picture, atol=1e-5)


def test_smoothing_keeps_what_agrees_and_damps_what_flickers() -> None:
    still = np.stack(np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5), axis=-1).astype(np.float32)
    steady, flash = drawn(20, 20).astype(np.float32), drawn(60, 60, 10).astype(np.float32)
    mean = smoothed(steady + flash, [(steady, still), (steady, still)], weight=0.5)
    assert np.allclose(mean[drawn(20, 20)], 1.0, atol=1e-5)
    assert np.allclose(mean[drawn(60, 60, 10)], 0.5, atol=1e-5)
    assert np.array_equal(smoothed(steady, [], 0.5), steady)


def test_iou_of_nothing_is_not_a_number_made_up() -> None:
    nothing = np.zeros((SIZE, SIZE), bool)
    flow = body_flow(square(20, 20), square(20, 20), FACES, SIZE, SIZE)
    assert warped_iou(nothing, nothing, flow, ~nothing) is None
    assert warped_iou(drawn(20, 20), nothing, flow, ~nothing) == 0.0
