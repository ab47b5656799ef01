"""Bounds of points and masks in one question to a device are those that are found one by one."""

from __future__ import annotations

import pytest
import torch

from occfusion.geometry import boxes
from occfusion.types import Camera

CAMERA = Camera(torch.eye(4), torch.tensor([[50.0, 0, 20.0], [0, 60.0, 15.0], [0, 0, 1]]), 40, 30)


@pytest.mark.parametrize("seed", range(6))
def test_as_one_by_one(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(50, 3, generator=generator) + torch.tensor([0.0, 0.0, 1.0])
    mask = torch.rand(30, 40, generator=generator) > 0.99
    found = boxes._bounds_at_once(points, mask, CAMERA)
    assert found == (boxes.points_bounds(points, CAMERA), boxes.mask_bounds(mask))


def test_nothing_before_the_camera_and_no_pixel() -> None:
    points = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    assert boxes._bounds_at_once(points, torch.zeros(30, 40, dtype=torch.bool), CAMERA) == (None, None)


def test_places_far_outside_are_bounded_alike() -> None:
    points = torch.tensor([[1e9, -1e9, 0.02], [0.0, 0.0, 1.0]])
    mask = torch.ones(30, 40, dtype=torch.bool)
    found = boxes._bounds_at_once(points, mask, CAMERA)
    assert found == (boxes.points_bounds(points, CAMERA), (0, 0, 40, 30))
