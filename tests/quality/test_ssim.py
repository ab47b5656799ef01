from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.metrics import ssim as kornia_ssim
from torchmetrics.functional.image import structural_similarity_index_measure

from occfusion.quality import metrics
from occfusion.quality.ssim import ssim_map
from oracles import quality as oracle
from quality.pictures import noise


@pytest.mark.parametrize("size", [(13, 17), (11, 12), (5, 5), (7, 30), (2, 3), (1, 1), (4, 1)])
def test_map_is_the_formula_at_every_pixel(size):
    a, b = noise(*size)
    np.testing.assert_allclose(
        ssim_map(a, b).numpy(), oracle.ssim_map(a.numpy(), b.numpy()), rtol=0, atol=1e-12
    )


def test_agrees_with_two_libraries():
    a, b = noise(40, 33)
    batch = [p.permute(2, 0, 1)[None] for p in (a, b)]
    assert metrics.ssim(a, b) == pytest.approx(
        float(structural_similarity_index_measure(*batch, data_range=1.0)), abs=1e-9
    )
    theirs = kornia_ssim(*batch, window_size=11, max_val=1.0, eps=0.0)[0].permute(1, 2, 0)
    torch.testing.assert_close(ssim_map(a, b), theirs, rtol=0, atol=1e-9)


@pytest.mark.parametrize("size", [(12, 14), (5, 5), (3, 13), (1, 2)])
def test_gradient_with_respect_to_both_pictures(size):
    a, b = (p.requires_grad_() for p in noise(*size))
    assert torch.autograd.gradcheck(ssim_map, (a, b), fast_mode=a.numel() > 50)


def test_gradient_of_a_picture_against_a_fixed_target():
    a, b = noise(14, 12)
    a.requires_grad_()
    ssim_map(a, b).square().sum().backward()
    half = a.grad.clone()
    both = (a.detach().requires_grad_(), b.requires_grad_())
    ssim_map(*both).square().sum().backward()
    torch.testing.assert_close(half, both[0].grad, rtol=0, atol=0)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("size", [(5, 5), (32, 20)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equal_flat_pictures_score_exactly_one(value, size, dtype):
    a = torch.full((*size, 3), value, dtype=dtype, requires_grad=True)
    values = ssim_map(a, a.detach().clone())
    assert (values == 1).all()
    values.sum().backward()
    assert a.grad.isfinite().all()


def test_black_against_white_is_nearly_zero():
    values = ssim_map(torch.zeros(20, 20, 3), torch.ones(20, 20, 3))
    # only the luminance term is left: C1 / (1 + C1)
    torch.testing.assert_close(values, torch.full_like(values, 1e-4 / 1.0001), rtol=0, atol=2e-7)


@pytest.mark.stiff
def test_float32_on_bright_almost_flat_pictures():
    a, b = noise(48, 48)
    a, b = 1 - 0.05 * a, 1 - 0.05 * b
    error = (ssim_map(a.float(), b.float()).double() - ssim_map(a, b)).abs().max()
    assert error < 3e-4


def test_symmetric_bounded_and_blind_to_channel_order():
    a, b = noise(30, 25, dtype=torch.float32)
    values = ssim_map(a, b)
    torch.testing.assert_close(values, ssim_map(b, a))
    torch.testing.assert_close(values.flip(2), ssim_map(a.flip(2), b.flip(2)))
    assert values.abs().max() <= 1


@pytest.mark.parametrize(
    ("rows", "columns"),
    [
        ((30, 90), (20, 70)),
        ((0, 50), (0, 40)),
        ((60, 100), (41, 80)),
        ((0, 100), (30, 31)),
        ((99, 100), (79, 80)),
    ],
)
def test_over_black_is_the_same_number_for_less_work(rows, columns):
    a, b = (torch.zeros(100, 80, 3, dtype=torch.float64) for _ in range(2))
    height, width = rows[1] - rows[0], columns[1] - columns[0]
    a[rows[0] : rows[1], columns[0] : columns[1]], b[rows[0] : rows[1], columns[0] : columns[1]] = noise(
        height, width
    )
    assert metrics.ssim_over_black(a, b) == pytest.approx(metrics.ssim(a, b), abs=1e-13)


def test_over_black_of_nothing():
    black = torch.zeros(30, 30, 3)
    assert metrics.ssim_over_black(black, black) == 1
    assert metrics.ssim_over_black(black[:5, :5], black[:5, :5]) == 1


def test_refuses_pictures_of_different_size():
    with pytest.raises(ValueError, match="one size"):
        ssim_map(torch.zeros(5, 5, 3), torch.zeros(5, 6, 3))
