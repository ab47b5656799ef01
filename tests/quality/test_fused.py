"""L1 and SSIM in one pass against the slow oracle, and its gradient against that of the plain terms in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from occfusion.quality import losses
from oracles import quality as oracle

SIZES = [(40, 31), (11, 11), (12, 3), (5, 7), (2, 9), (1, 1), (64, 20)]


def pictures(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    a, b = torch.rand(2, height, width, 3, generator=generator)
    mask = torch.rand(height, width, generator=generator) > 0.4
    mask[height // 2, width // 2] = True
    return a, b, mask


@pytest.mark.parametrize("size", SIZES)
def test_values_are_those_of_the_oracle(size):
    a, b, mask = pictures(*size)
    black = mask[..., None].numpy()
    similarity = oracle.ssim_map(a.double().numpy() * black, b.double().numpy() * black)
    l1, ssim = losses.l1_and_ssim(a, b, mask)
    inside = mask.numpy()
    assert float(l1) == pytest.approx(
        np.abs(a.double().numpy() - b.double().numpy())[inside].mean(), abs=1e-7
    )
    assert float(ssim) == pytest.approx(1 - similarity[inside].mean(), abs=2e-6)


@pytest.mark.parametrize("kind", ["noise", "flat", "alike", "extreme"])
@pytest.mark.parametrize("size", SIZES)
def test_gradients_are_those_of_the_plain_terms(size, kind):
    a, b, mask = pictures(*size)
    if kind == "flat":
        a, b = torch.full_like(a, 0.97), torch.full_like(b, 0.95)
    elif kind == "alike":
        a = b + 1e-3 * (a - 0.5)
    elif kind == "extreme":
        a, b = (a > 0.5).float(), (b > 0.5).float()
    ours, exact = a.clone().requires_grad_(), a.double().requires_grad_()
    for x, compiled in ((ours, True), (exact, False)):
        l1, ssim = losses.l1_and_ssim(x, b.to(x.dtype), mask, compiled=compiled)
        (3 * l1 + 2 * ssim).backward()
    assert ours.grad is not None and exact.grad is not None
    scale = float(exact.grad.abs().max())
    # where both are flat and bright, float32 leaves 3e-4 of the map (`ssim_map`)
    torch.testing.assert_close(
        ours.grad.double(), exact.grad, rtol=0, atol=scale * (3e-3 if kind == "flat" else 2e-5)
    )


@pytest.mark.parametrize("margin", [1, 3])
def test_ssim_stays_within_the_mask_and_l1_does_not(margin):
    a, b, mask = pictures(40, 31)
    mask = torch.zeros_like(mask)
    mask[5:30, 4:] = True  # to the picture's border, which is no edge of the mask
    inner = torch.zeros_like(mask)
    inner[5 + margin : 30 - margin, 4 + margin :] = True
    assert torch.equal(losses.within(mask, margin), inner)
    black, inside = inner[..., None].numpy(), inner.numpy()
    similarity = oracle.ssim_map(a.double().numpy() * black, b.double().numpy() * black)
    ours, exact = a.clone().requires_grad_(), a.double().requires_grad_()
    for x, compiled in ((ours, True), (exact, False)):
        l1, ssim = losses.l1_and_ssim(x, b.to(x.dtype), mask, margin, compiled=compiled)
        assert l1.item() == pytest.approx(float((a - b).abs()[mask].mean()), abs=1e-6)
        assert ssim.item() == pytest.approx(1 - similarity[inside].mean(), abs=2e-6)
        (3 * l1 + 2 * ssim).backward()
    assert ours.grad is not None and exact.grad is not None
    bound = 2e-5 * float(exact.grad.abs().max())
    torch.testing.assert_close(ours.grad.double(), exact.grad, rtol=0, atol=bound)


@pytest.mark.parametrize("margin", [0, 1, 2])
def test_within_is_what_a_slow_search_for_the_nearest_edge_says(margin):
    _, _, mask = pictures(17, 12)
    mask |= torch.rand(17, 12, generator=torch.Generator().manual_seed(1)) > 0.1
    outside = (~mask).nonzero()
    slow = mask.clone()
    for y, x in mask.nonzero().tolist():
        slow[y, x] = int((outside - torch.tensor([y, x])).abs().amax(dim=1).min()) > margin
    assert torch.equal(losses.within(mask, margin), slow)
    assert losses.within(torch.ones(4, 4, dtype=torch.bool), margin).all()


def test_the_gradient_is_the_slope_of_the_value():
    a, b, mask = pictures(14, 17)
    x = a.clone().requires_grad_()
    sum(losses.l1_and_ssim(x, b, mask)).backward()  # type: ignore[union-attr]
    assert x.grad is not None
    direction = torch.sign(x.grad) * 1e-3
    up, down = (sum(map(float, losses.l1_and_ssim(a + s * direction, b, mask))) for s in (1, -1))
    assert (up - down) / 2 == pytest.approx(float((x.grad * direction).sum()), rel=2e-2)


def test_what_lies_outside_the_mask_counts_for_nothing():
    a, b, mask = pictures(20, 15)
    x = a.clone()
    x[~mask] = float("nan")
    x.requires_grad_()
    values = losses.l1_and_ssim(x, b, mask)
    sum(values).backward()  # type: ignore[union-attr]
    assert values == losses.l1_and_ssim(a, b, mask)
    assert x.grad is not None and (x.grad[~mask] == 0).all() and torch.isfinite(x.grad).all()


@pytest.mark.parametrize("size", [(15, 13), (0, 0), (0, 7)])
def test_an_empty_region_costs_nothing(size):
    a = torch.rand(*size, 3, requires_grad=True)
    values = losses.l1_and_ssim(a, torch.rand(*size, 3), torch.zeros(size, dtype=torch.bool))
    sum(values).backward()  # type: ignore[union-attr]
    assert values == (0, 0)
    assert a.grad is not None and (a.grad == 0).all()


def test_threads_change_no_bit():
    a, b, mask = pictures(50, 41)
    results = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            x = a.clone().requires_grad_()
            values = losses.l1_and_ssim(x, b, mask)
            sum(values).backward()  # type: ignore[union-attr]
            results.append((*values, x.grad))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(one, two) for one, two in zip(results[0], other, strict=True))


def test_other_types_take_the_plain_terms():
    a, b, mask = pictures(9, 9)
    l1, ssim = losses.l1_and_ssim(a.double(), b.double(), mask)
    assert l1.dtype == ssim.dtype == torch.float64
