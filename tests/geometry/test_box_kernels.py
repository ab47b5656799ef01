"""Boxes by compiled passes against torch's, and against what they are for."""

from __future__ import annotations

import pytest
import torch

from occfusion.geometry.boxes import mask_bounds, person_box, points_bounds
from occfusion.types import Camera

WIDTH, HEIGHT = 90, 70
CAMERA = Camera(
    torch.eye(4) + torch.tensor([[0, 0, 0, 0.1], [0, 0, 0, -0.2], [0, 0, 0, 3.0], [0, 0, 0, 0]]),
    torch.tensor([[110.0, 0, 44], [0, 105.0, 33], [0, 0, 1]]),
    WIDTH,
    HEIGHT,
)
EMPTY = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)


@pytest.mark.parametrize("seed", range(12))
def test_boxes_of_points_hold_all_of_them(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(200, 3, generator=generator) * 0.4
    points[3] = torch.tensor([0.0, 0.0, -5.0])  # behind the camera
    x, y, w, h = person_box(points, EMPTY, CAMERA, 0, compiled=True)
    exact = points_bounds(points.double(), Camera(CAMERA.viewmat.double(), CAMERA.K.double(), WIDTH, HEIGHT))
    assert exact is not None
    left, top, right, bottom = exact
    wanted = (max(left, 0), max(top, 0), min(right, WIDTH), min(bottom, HEIGHT))
    # a place within rounding of a whole pixel may fall on either side of it
    assert max(abs(a - b) for a, b in zip((x, y, x + w, y + h), wanted, strict=True)) <= 1
    assert person_box(points, EMPTY, CAMERA, 0) == pytest.approx((x, y, w, h), abs=1)


@pytest.mark.parametrize("seed", range(12))
def test_boxes_of_masks_are_exact(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    mask = EMPTY.clone()
    for _ in range(seed):
        y, x = (int(torch.randint(size, (), generator=generator)) for size in (HEIGHT, WIDTH))
        mask[y, x] = True
    nobody = torch.full((3, 3), -9.0)
    found = person_box(nobody, mask, CAMERA, 2, compiled=True)
    assert found == person_box(nobody, mask, CAMERA, 2)
    bounds = mask_bounds(mask)
    if bounds is None:
        assert found == (0, 0, WIDTH, HEIGHT)
    else:
        rows, columns = mask.nonzero().T
        assert bounds == (int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1)


def test_points_that_are_no_numbers_or_far_away_are_bounded() -> None:
    points = torch.tensor([[float("nan"), 0.0, 0.0], [1e30, 0.0, 0.0], [0.0, 0.0, 0.0]])
    x, _, w, _ = person_box(points, EMPTY, CAMERA, 0, compiled=True)
    assert x + w == WIDTH


def test_no_points() -> None:
    assert person_box(torch.zeros(0, 3), EMPTY, CAMERA, 3, compiled=True) == (0, 0, WIDTH, HEIGHT)
