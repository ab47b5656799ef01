"""Compiled axis-angles against the matrix exponential, and their gradient against double precision."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from occfusion.geometry.rotation import axis_angle_to_matrix

LENGTHS = (0.0, 1e-8, 1e-3, 0.0999, 0.1001, 0.5, 1.5, 3.1415, 3.2, 6.2, 40.0)


def vectors() -> torch.Tensor:
    drawn = torch.randn(len(LENGTHS), 9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return drawn / drawn.norm(dim=-1, keepdim=True) * torch.tensor(LENGTHS).double()[:, None, None]


def exponential(vector: torch.Tensor) -> torch.Tensor:
    x, y, z = vector
    zero = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3))


def test_matrices_are_exponentials_and_turn_back() -> None:
    given = vectors().float()
    found = axis_angle_to_matrix(given, compiled=True)
    wanted = torch.stack([exponential(v) for v in given.double().view(-1, 3)]).view_as(found)
    assert_close(found.double(), wanted, atol=5e-7, rtol=0)
    back = axis_angle_to_matrix(-given, compiled=True)
    assert_close(found @ back, torch.eye(3).expand_as(found), atol=1e-6, rtol=0)


def test_gradients_are_those_of_double_precision_and_of_differences() -> None:
    weights = torch.randn(len(LENGTHS), 9, 3, 3, generator=torch.Generator().manual_seed(1)).double()
    single = vectors().float().requires_grad_()
    double = single.detach().double().requires_grad_()
    (axis_angle_to_matrix(single, compiled=True) * weights.float()).sum().backward()
    (axis_angle_to_matrix(double) * weights).sum().backward()
    assert_close(single.grad.double(), double.grad, atol=3e-6, rtol=3e-6)
    step = 1e-6
    for k in range(3):
        shift = step * torch.eye(3, dtype=torch.float64)[k]
        high, low = (
            torch.stack([exponential(v) for v in (double.detach() + s).view(-1, 3)]).view_as(weights)
            for s in (shift, -shift)
        )
        slope = ((high - low) * weights).sum(dim=(-1, -2)) / (2 * step)
        assert_close(single.grad[..., k].double(), slope, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("shape", [(0, 3), (3,), (2, 4, 3)])
def test_shapes_are_kept(shape: tuple[int, ...]) -> None:
    given = torch.full(shape, 0.2)
    assert_close(axis_angle_to_matrix(given, compiled=True), axis_angle_to_matrix(given), atol=1e-6, rtol=0)
