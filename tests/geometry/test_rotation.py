from __future__ import annotations

import math

import kornia.geometry.conversions as kornia
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck, gradgradcheck

from occfusion.geometry import rotation
from oracles.rotation import (
    conjugate,
    cross_matrix,
    exponential,
    matrix_to_axis_angle,
    quaternion_to_axis_angle,
)

ANGLES = [0.0, 1e-300, 1e-12, 1e-5, 0.0999999, 0.1, 0.1000001, 1.0, math.pi / 2, math.pi - 1e-9, math.pi]
ANGLES += [math.pi + 1e-9, 2 * math.pi, 20.0, 100.0]
AXES = np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1], [1, 2, -3], [-1, 1e-9, 1]], dtype=float)
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)
VECTORS = torch.tensor(np.array([axis * angle for axis in AXES for angle in ANGLES]))

unit = st.floats(-1, 1, allow_nan=False)
vectors = st.tuples(*[st.floats(-10, 10, allow_nan=False)] * 3)


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 5e-14), (torch.float32, 1.5e-5)])
def test_axis_angle_equals_matrix_exponential(dtype, bound):
    want = np.array([exponential(vector) for vector in VECTORS.numpy()])
    got = rotation.axis_angle_to_matrix(VECTORS.to(dtype))
    assert got.dtype == dtype
    # an angle of 100 is itself only known to 4e-6 in float32
    assert np.abs(got.double().numpy() - want).max() < bound
    assert (got @ got.mT - torch.eye(3, dtype=dtype)).abs().max() < bound / 10


def test_axis_angle_agrees_with_kornia():
    generator = torch.Generator().manual_seed(1)
    vectors = torch.randn(200, 3, generator=generator, dtype=torch.float64) * 2
    got = rotation.axis_angle_to_matrix(vectors)
    assert torch.allclose(got, kornia.axis_angle_to_rotation_matrix(vectors), atol=1e-12, rtol=0)


@pytest.mark.stiff
def test_gradient_of_axis_angle_is_finite_and_right_everywhere():
    vectors = VECTORS.clone().requires_grad_()
    weights = torch.randn(len(vectors), 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (rotation.axis_angle_to_matrix(vectors) * weights).sum().backward()
    assert torch.isfinite(vectors.grad).all()
    step = 1e-6
    for row, (vector, weight) in enumerate(zip(VECTORS.numpy(), weights.numpy(), strict=True)):
        for axis in range(3):
            ahead, behind = vector.copy(), vector.copy()
            ahead[axis] += step
            behind[axis] -= step
            slope = ((exponential(ahead) - exponential(behind)) * weight).sum() / (2 * step)
            assert abs(slope - float(vectors.grad[row, axis])) < 2e-8, (vector, axis)


def test_gradient_at_zero_is_the_cross_product():
    jacobian = torch.autograd.functional.jacobian(
        rotation.axis_angle_to_matrix, torch.zeros(3, dtype=torch.float64)
    )
    for axis in range(3):
        assert np.array_equal(jacobian[..., axis].numpy(), cross_matrix(np.eye(3)[axis]))


@pytest.mark.parametrize("scale", [1e-8, 1e-2, 1.0, 3.0])
def test_axis_angle_gradcheck(scale):
    vectors = torch.randn(4, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * scale
    vectors.requires_grad_()
    assert gradcheck(rotation.axis_angle_to_matrix, vectors)
    assert gradgradcheck(rotation.axis_angle_to_matrix, vectors)


@given(vectors, vectors)
@settings(max_examples=50, deadline=None, derandomize=True)
def test_axis_angles_along_one_axis_add(first, second):
    axis = torch.tensor(first, dtype=torch.float64)
    share = second[0] / 10
    one, other = (rotation.axis_angle_to_matrix(axis * factor) for factor in (1.0, share))
    assert torch.allclose(one @ other, rotation.axis_angle_to_matrix(axis * (1 + share)), atol=1e-12)


@pytest.mark.parametrize("length", [1e-11, 1e-3, 1.0, 1e20, 1e300])
def test_quaternion_equals_conjugation_at_any_length(length):
    quats = np.random.default_rng(3).normal(size=(20, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    want = np.array([conjugate(q) for q in quats])
    got = rotation.quaternion_to_matrix(torch.tensor(quats * length))
    assert np.abs(got.numpy() - want).max() < 1e-14


@pytest.mark.stiff
@pytest.mark.parametrize("value", [0.0, 1e-45, 1e-30, 1e-13, 1e20, 3e38])
def test_extreme_quaternions_have_finite_gradients(value):
    quats = torch.tensor([[value, value, 0.0, 0.0], [0.0, 0.0, 0.0, value]], requires_grad=True)
    matrices = rotation.quaternion_to_matrix(quats)
    assert (matrices @ matrices.mT - torch.eye(3)).abs().max() < 1e-6
    weights = torch.arange(18.0).view(2, 3, 3)
    (matrices * weights).sum().backward()
    assert torch.isfinite(quats.grad).all()
    if value < 1e-12:
        assert torch.equal(matrices, torch.eye(3).expand(2, 3, 3)), "too short to have a direction"
        assert not quats.grad.any()


def test_quaternion_gradcheck():
    quats = torch.randn(
        5, 4, generator=torch.Generator().manual_seed(4), dtype=torch.float64, requires_grad=True
    )
    assert gradcheck(rotation.quaternion_to_matrix, quats)
    assert gradcheck(rotation.normalize_quaternion, quats)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_matrix_to_quaternion_and_back_at_every_angle(dtype):
    matrices = torch.tensor(np.array([exponential(vector) for vector in VECTORS.numpy()])).to(dtype)
    quats = rotation.matrix_to_quaternion(matrices)
    assert (quats[:, 0] >= 0).all()
    bound = 1e-14 if dtype == torch.float64 else 1e-6
    assert (rotation.quaternion_to_matrix(quats) - matrices).abs().max() < bound
    again = rotation.axis_angle_to_matrix(matrix_to_axis_angle(matrices))
    assert (again - matrices).abs().max() < 10 * bound


def test_matrix_to_quaternion_agrees_with_kornia():
    matrices = torch.tensor(np.array([exponential(v) for v in np.random.default_rng(5).normal(size=(50, 3))]))
    want = kornia.rotation_matrix_to_quaternion(matrices)
    want = torch.where(want[:, :1] < 0, -want, want)
    assert (rotation.matrix_to_quaternion(matrices) - want).abs().max() < 1e-7


@pytest.mark.stiff
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-4, 0.0999, 0.21, 2.0, math.pi - 1e-7])
def test_log_map_inverts_the_exponential(angle):
    vectors = torch.tensor(AXES * angle, requires_grad=True)
    axes = torch.tensor(AXES)
    quats = torch.cat([torch.full_like(axes[:, :1], math.cos(angle / 2)), axes * math.sin(angle / 2)], dim=1)
    assert (quaternion_to_axis_angle(quats) - vectors).abs().max() <= 1e-15 * max(angle, 1.0)
    recovered = matrix_to_axis_angle(rotation.axis_angle_to_matrix(vectors))
    recovered.sum().backward()
    # the identity's gradient; next to pi the matrix knows its axis to 1e-9 only
    assert (vectors.grad - 1).abs().max() < 1e-6


@pytest.mark.parametrize("lead", [(), (1,), (0,), (2, 3)])
def test_leading_dimensions(lead):
    generator = torch.Generator().manual_seed(7)
    vectors = torch.randn(*lead, 3, generator=generator)
    quats = torch.randn(*lead, 4, generator=generator)
    assert rotation.axis_angle_to_matrix(vectors).shape == (*lead, 3, 3)
    matrices = rotation.quaternion_to_matrix(quats)
    assert matrices.shape == (*lead, 3, 3)
    assert rotation.matrix_to_quaternion(matrices).shape == (*lead, 4)
    assert matrix_to_axis_angle(matrices).shape == (*lead, 3)
    if lead == (2, 3):
        assert torch.equal(matrices[1, 2], rotation.quaternion_to_matrix(quats[1, 2]))


@pytest.mark.stiff
@pytest.mark.parametrize("tilt", [0.0, 1e-9, 1e-4, 1.0, math.pi - 1e-4, math.pi - 1e-9, math.pi])
def test_z_axis_is_turned_the_shortest_way(tilt):
    headings = torch.linspace(0.0, 6.0, 7, dtype=torch.float64)
    sine = math.sin(tilt)
    directions = torch.stack(
        [sine * headings.cos(), sine * headings.sin(), torch.full_like(headings, math.cos(tilt))], dim=1
    )
    quats = rotation.z_axis_to(directions)
    matrices = rotation.quaternion_to_matrix(quats)
    # next to -z the axis of the half turn is a choice
    assert (matrices[:, :, 2] - directions).abs().max() < (2e-3 if math.pi - 2e-3 < tilt < math.pi else 1e-12)
    assert (matrix_to_axis_angle(matrices).norm(dim=1) - tilt).abs().max() < 2e-3
