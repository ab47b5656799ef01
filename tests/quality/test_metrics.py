from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchmetrics.functional.image import peak_signal_noise_ratio

from occfusion.quality import metrics
from oracles import quality as oracle
from quality.pictures import noise


def test_psnr_against_the_formula_and_a_library():
    a, b = noise(9, 14)
    mask = torch.rand(9, 14, generator=torch.Generator().manual_seed(1)) > 0.5
    assert metrics.psnr(a, b, mask) == pytest.approx(
        oracle.psnr(a.numpy(), b.numpy(), mask.numpy()), abs=1e-10
    )
    assert metrics.psnr(a, b) == pytest.approx(float(peak_signal_noise_ratio(a, b, data_range=1.0)), abs=1e-5)


def test_psnr_of_equal_pictures_is_the_cap_and_of_nothing_is_none():
    a = torch.rand(4, 4, 3)
    assert metrics.psnr(a, a) == metrics.PSNR_CAP
    assert metrics.psnr(a.double(), a.double() + 2e-5) == pytest.approx(-20 * math.log10(2e-5))
    assert metrics.psnr(a.double(), a.double() + 1e-6) == metrics.PSNR_CAP
    nothing = torch.zeros(4, 4, dtype=torch.bool)
    assert metrics.psnr(a, a, nothing) is None
    assert metrics.ssim(a, a, nothing) is None


def test_ssim_in_a_region_is_the_mean_of_the_map():
    a, b = noise(13, 12)
    mask = torch.zeros(13, 12, dtype=torch.bool)
    mask[2:5, 7:] = True
    expected = oracle.ssim_map(a.numpy(), b.numpy())[mask.numpy()].mean()
    assert metrics.ssim(a, b, mask) == pytest.approx(expected, abs=1e-12)


def test_mask_iou_counts_pixels():
    a = torch.tensor([[1, 1, 0, 0], [1, 0, 0, 0]], dtype=torch.bool)
    b = torch.tensor([[1, 0, 0, 1], [1, 1, 0, 0]], dtype=torch.bool)
    assert metrics.mask_iou(a, b) == 2 / 5
    left = torch.tensor([[1, 1, 0, 0], [1, 0, 0, 0]], dtype=torch.bool)
    assert metrics.mask_iou(a, b, left) == 2 / 3
    assert metrics.mask_iou(a, a) == 1
    assert metrics.mask_iou(a, ~a) == 0
    assert metrics.mask_iou(a & ~a, a & ~a) is None


@settings(max_examples=60, deadline=None)
@given(
    size=st.tuples(st.integers(1, 60), st.integers(1, 60)),
    corners=st.tuples(*[st.floats(0, 1)] * 4),
    padding=st.one_of(st.none(), st.integers(0, 80)),
)
def test_padded_box(size, corners, padding):
    height, width = size
    y0, y1 = sorted(int(c * (height - 1)) for c in corners[:2])
    x0, x1 = sorted(int(c * (width - 1)) for c in corners[2:])
    mask = torch.zeros(size, dtype=torch.bool)
    mask[y0, x0] = mask[y1, x1] = True
    x, y, w, h = metrics.padded_box(mask, padding)
    assert x >= 0 and y >= 0 and x + w <= width and y + h <= height
    if padding is None:
        assert w >= min(11, width) and h >= min(11, height)
        assert x <= max(x0 - 0.1 * (x1 + 1 - x0), 0) and y + h >= min(y1 + 1 + 0.1 * (y1 + 1 - y0), height)
    else:
        assert (x, y) == (max(x0 - padding, 0), max(y0 - padding, 0))
        assert (x + w, y + h) == (min(x1 + 1 + padding, width), min(y1 + 1 + padding, height))


def test_no_box_without_pixels():
    assert metrics.padded_box(torch.zeros(5, 5, dtype=torch.bool)) is None
