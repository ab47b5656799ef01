"""Compiled colours of posed Gaussians against their specification in double precision, which is gradient-checked."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.human import Gaussians
from occfusion.human.carry import Carried
from occfusion.human.shading import posed_colors

COUNT, VERTICES = 1500, 40
"""More Gaussians than a thread takes at a time."""
LAMP = torch.tensor([0.3, -0.4, 0.2])
CENTRE = torch.tensor([0.3, -0.5, 3.0])


def made(degree: int, dtype: torch.dtype, allocated: int = 1):
    """Gaussians and where they are carried, all of which learn; some colours are below 0, one touches the camera."""
    generator = torch.Generator().manual_seed(3)
    gaussians = Gaussians(torch.zeros(COUNT, 3), torch.full((COUNT, 3), 0.01), allocated)
    with torch.no_grad():
        gaussians.sh0.copy_(torch.randn(COUNT, 1, 3, generator=generator))
        gaussians.sh_rest.copy_(torch.randn(gaussians.sh_rest.shape, generator=generator))
    gaussians.set_vertex_index(torch.randint(VERTICES, (COUNT,), generator=generator))
    means, linear = torch.randn(COUNT, 3, generator=generator), torch.randn(3, 3, COUNT, generator=generator)
    means[7] = CENTRE
    normals = torch.randn(VERTICES, 3, generator=generator)
    gaussians = gaussians.to(dtype)
    leaves = [tensor.to(dtype).requires_grad_() for tensor in (means, linear)]
    return gaussians, Carried(leaves[0], torch.zeros(0), leaves[1]), normals.to(dtype), degree


def gradients(gaussians, carried, normals, degree, lamp, weights):
    colors = posed_colors(gaussians, degree, carried, CENTRE, normals, lamp)
    (colors * weights).sum().backward()
    return colors, [t.grad for t in (gaussians.sh0, gaussians.sh_rest, carried.means, carried.linear)]


@pytest.mark.parametrize("allocated", [1, 3])
@pytest.mark.parametrize("lit", [False, True])
@pytest.mark.parametrize("degree", [0, 1])
def test_kernels_say_what_the_specification_says(degree: int, lit: bool, allocated: int) -> None:
    weights = torch.randn(COUNT, 3, generator=torch.Generator().manual_seed(4)).double()
    lamp = LAMP if lit else None
    found, of_kernel = gradients(*made(degree, torch.float32, allocated), lamp, weights.float())
    wanted, of_text = gradients(
        *made(degree, torch.float64, allocated), None if lamp is None else lamp.double(), weights
    )
    assert (wanted == 0).any() and (wanted > 0).any()
    assert_close(found.double(), wanted, atol=2e-6, rtol=2e-6)
    for mine, theirs in zip(of_kernel, of_text, strict=True):
        assert (mine is None) == (theirs is None)
        if mine is not None:
            touching = torch.arange(COUNT) != 7  # its gradient is 1e6 times the others'
            last = mine.dim() == 3 and mine.shape[-1] == COUNT
            mine, theirs = (t[..., touching] if last else t[touching] for t in (mine, theirs))
            assert_close(mine.double(), theirs, atol=1e-4, rtol=1e-4)


def test_turning_world_camera_and_lamp_together_changes_nothing() -> None:
    gaussians, carried, normals, _ = made(1, torch.float32)
    turn = axis_angle_to_matrix(torch.tensor([0.4, -1.0, 0.3]))
    turned = Carried(
        carried.means.detach() @ turn.T,
        carried.covariances,
        torch.einsum("ij,jkn->ikn", turn, carried.linear.detach()),
    )
    before = posed_colors(gaussians, 1, carried, CENTRE, normals, LAMP)
    after = posed_colors(gaussians, 1, turned, turn @ CENTRE, normals, turn @ LAMP)
    keep = torch.arange(COUNT) != 7  # where it touches the camera it has no direction
    assert_close(after[keep], before[keep], atol=1e-5, rtol=1e-5)


def test_a_coefficient_that_is_not_a_number_shows() -> None:
    gaussians, carried, normals, _ = made(1, torch.float32)
    with torch.no_grad():
        gaussians.sh0[3, 0, 1] = float("nan")
    colors = posed_colors(gaussians, 1, carried, CENTRE, normals, LAMP)
    assert colors[3].isnan().tolist() == [False, True, False] and int(colors.isnan().sum()) == 1
