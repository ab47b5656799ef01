from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from occfusion.geometry.camera import camera_round, look_at, orbit_camera
from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.types import Camera
from oracles.camera import project_points


def test_projection_written_out():
    R = axis_angle_to_matrix(torch.tensor([0.2, -0.3, 0.1], dtype=torch.float64))
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = R, torch.tensor([0.1, -0.2, 4.0])
    K = torch.tensor([[500.0, 0, 250], [0, 510, 260], [0, 0, 1]], dtype=torch.float64)
    points = torch.randn(10, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pixels, depths = project_points(points, Camera(viewmat, K, 512, 512))
    for point, pixel, depth in zip(points.numpy(), pixels.numpy(), depths.numpy(), strict=True):
        x, y, z = R.numpy() @ point + viewmat[:3, 3].numpy()
        assert np.allclose(pixel, [500 * x / z + 250, 510 * y / z + 260], atol=1e-9)
        assert depth == pytest.approx(z)


@pytest.mark.stiff
def test_points_behind_are_marked_and_harm_no_gradient():
    camera = Camera(torch.eye(4), torch.eye(3), 8, 8)
    points = torch.tensor([[1.0, 1, 2], [1, 1, 0], [1, 1, 1e-20], [1, 1, -3]], requires_grad=True)
    pixels, depths = project_points(points, camera)
    assert torch.isnan(pixels).all(dim=1).tolist() == [False, True, True, True]
    (pixels[0].sum() + depths.sum()).backward()
    assert torch.isfinite(points.grad).all()


def test_projection_gradient():
    camera = Camera(torch.eye(4).double(), torch.eye(3).double() * 3, 8, 8)
    points = torch.rand(4, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 1
    assert gradcheck(lambda p: project_points(p, camera), points.requires_grad_())


@pytest.mark.parametrize("angle", [0.0, 0.7, math.pi, 5.0])
def test_orbit_sees_its_target_upright(angle):
    target = torch.tensor([0.5, 1.0, -2.0], dtype=torch.float64)
    camera = orbit_camera(target, angle, 3.0, math.radians(60), 100)
    up_unit = torch.tensor([0.0, 1, 0]).double()
    pixels, depths = project_points(torch.stack([target, target + 0.1 * up_unit]), camera)
    assert torch.allclose(pixels[0], torch.tensor([50.0, 50.0]).double(), atol=1e-9)
    assert depths[0] == pytest.approx(3.0)
    assert pixels[1, 1] < 50 and pixels[1, 0] == pytest.approx(50.0, abs=1e-9)
    assert (camera.centre - target).norm() == pytest.approx(3.0)
    assert abs((camera.centre - target) @ up_unit) < 1e-12
    assert torch.linalg.det(camera.viewmat[:3, :3]) == pytest.approx(1.0)


def test_orbit_starts_in_front_and_goes_counter_clockwise():
    origin = torch.zeros(3, dtype=torch.float64)
    assert torch.allclose(orbit_camera(origin, 0.0, 2.0, 1.0, 64).centre, torch.tensor([0, 0, 2.0]).double())
    quarter = orbit_camera(origin, math.pi / 2, 2.0, 1.0, 64).centre
    assert torch.allclose(quarter, torch.tensor([2.0, 0, 0]).double(), atol=1e-12)


def test_field_of_view_touches_the_sides():
    camera = orbit_camera(torch.zeros(3).double(), 0.0, 1.0, math.radians(90), 64)
    pixels, _ = project_points(torch.tensor([[1.0, 0, 0]]).double(), camera)
    assert pixels[0, 0] == pytest.approx(64.0)


@pytest.mark.parametrize(
    ("eye", "up"), [([0.0, 0, 0], [0.0, 1, 0]), ([0.0, 2, 0], [0.0, 1, 0]), ([1.0, 0, 0], [0.0] * 3)]
)
def test_no_such_view(eye, up):
    with pytest.raises(ValueError, match="line of sight"):
        look_at(torch.tensor(eye), torch.zeros(3), torch.tensor(up))


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0, math.pi, -1.3])
def test_a_camera_goes_round_its_target(angle):
    """A tilted, rolled camera that looks past the target, and an axis of any length and direction."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = axis_angle_to_matrix(torch.tensor([0.2, 2.9, 0.3], dtype=torch.float64))
    viewmat[:3, 3] = torch.tensor([0.3, -0.2, 3.0])
    K = torch.tensor([[500.0, 0.0, 90.0], [0.0, 510.0, 70.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    camera, target = Camera(viewmat, K, 160, 120), torch.tensor([0.1, 0.4, 0.2], dtype=torch.float64)
    axis = torch.tensor([0.6, 2.0, -0.9], dtype=torch.float64)
    found, distance = camera_round(camera, target, axis, angle), float((camera.centre - target).norm())
    unit = axis / axis.norm()
    pixels, depths = project_points(torch.stack([target, target + 0.1 * unit]), found)
    assert pixels[0].tolist() == pytest.approx([80.0, 60.0]) and float(depths[0]) == pytest.approx(distance)
    assert float(pixels[1, 0]) == pytest.approx(80.0) and float(pixels[1, 1]) < 60.0  # upright
    torch.testing.assert_close(found.K[:2, :2], K[:2, :2])
    before, after = camera.centre - target, found.centre - target
    before = before - (before @ unit) * unit
    assert float(after @ unit) == pytest.approx(0.0, abs=1e-9)
    sine, cosine = torch.linalg.cross(before, after) @ unit, before @ after
    scale = float(before.norm()) * distance
    assert float(sine) == pytest.approx(scale * math.sin(angle), abs=1e-9)
    assert float(cosine) == pytest.approx(scale * math.cos(angle), abs=1e-9)


def test_a_camera_that_is_too_near_steps_back_and_shows_its_target_as_large():
    up, origin = torch.tensor([0.0, 1.0, 0.0]), torch.zeros(3)
    K = torch.tensor([[50.0, 0.0, 3.0], [0.0, 60.0, 5.0], [0.0, 0.0, 1.0]])
    near = Camera(look_at(torch.tensor([0.0, 0.0, 0.5]), origin, up), K, 9, 7)
    for nearest, distance in ((0.4, 0.5), (2.0, 2.0)):
        found = camera_round(near, origin, up, 1.0, nearest=nearest)
        assert float(found.centre.norm()) == pytest.approx(distance)
        expected = [[100.0 * distance, 0.0, 4.5], [0.0, 120.0 * distance, 3.5], [0.0, 0.0, 1.0]]
        torch.testing.assert_close(found.K, torch.tensor(expected, dtype=torch.float64))


def test_a_camera_that_looks_along_the_axis_has_sides_too():
    above = Camera(look_at(*torch.eye(3).mul(3.0)[[1, 0]], torch.tensor([0.0, 0.0, 1.0])), torch.eye(3), 4, 4)
    target, axis = above.centre - torch.tensor([0.0, 2.0, 0.0]), torch.tensor([0.0, 1.0, 0.0])
    eyes = [camera_round(above, target, axis, k * math.pi / 2).centre - target for k in range(4)]
    assert all(float(eye.norm()) == pytest.approx(2.0, abs=1e-5) for eye in eyes)
    assert float((eyes[0] + eyes[2]).norm()) == pytest.approx(0.0, abs=1e-5)
    assert float(eyes[0] @ eyes[1]) == pytest.approx(0.0, abs=1e-5)
