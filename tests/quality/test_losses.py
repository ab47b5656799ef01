from __future__ import annotations

import pytest
import torch

from occfusion.quality import losses
from oracles import quality as oracle
from quality.pictures import noise

TERMS = (losses.l1, losses.l2, losses.ssim_loss)


@pytest.fixture
def mask():
    return torch.rand(15, 13, generator=torch.Generator().manual_seed(3)) > 0.6


def test_means_over_the_mask(mask):
    a, b = noise(15, 13)
    inside = [(y, x) for y in range(15) for x in range(13) if mask[y, x]]
    l1 = sum(float((a[p] - b[p]).abs().sum()) for p in inside) / (3 * len(inside))
    l2 = sum(float(((a[p] - b[p]) ** 2).sum()) for p in inside) / (3 * len(inside))
    similarity = oracle.ssim_map(a.numpy(), b.numpy())
    ssim = 1 - sum(similarity[p].sum() for p in inside) / (3 * len(inside))
    for term, expected in zip(TERMS, (l1, l2, ssim), strict=True):
        assert float(term(a, b, mask)) == pytest.approx(expected, abs=1e-12)


def test_without_a_mask_every_pixel_counts():
    a, b = noise(15, 13)
    everywhere = torch.ones(15, 13, dtype=torch.bool)
    for term in TERMS:
        torch.testing.assert_close(term(a, b), term(a, b, everywhere))
    # the occupancy map has no channels
    torch.testing.assert_close(losses.l2(a[..., 0], b[..., 0]), (a[..., 0] - b[..., 0]).square().mean())


@pytest.mark.parametrize("term", TERMS)
def test_gradients(term, mask):
    a, b = (p.requires_grad_() for p in noise(15, 13))
    assert torch.autograd.gradcheck(lambda a, b: term(a, b, mask), (a, b), fast_mode=True)


@pytest.mark.parametrize("term", TERMS)
@pytest.mark.parametrize("size", [(15, 13), (1, 1), (0, 0), (0, 7)])
def test_an_empty_region_costs_nothing_and_pulls_at_nothing(term, size):
    a = torch.rand(*size, 3, requires_grad=True)
    value = term(a, torch.rand(*size, 3), torch.zeros(size, dtype=torch.bool))
    value.backward()
    assert value == 0
    assert (a.grad == 0).all()


@pytest.mark.parametrize("term", TERMS[:2])
def test_what_lies_outside_the_mask_cannot_poison_the_loss(term, mask):
    a, b = noise(15, 13)
    with torch.no_grad():
        a[~mask] = float("nan")
    a.requires_grad_()
    value = term(a, b, mask)
    value.backward()
    assert value.isfinite()
    assert a.grad[mask].isfinite().all()
    assert (a.grad[mask] != 0).any()


@pytest.mark.parametrize("term", TERMS)
def test_equal_pictures_cost_nothing(term, mask):
    a, _ = noise(15, 13, dtype=torch.float32)
    assert term(a, a.clone(), mask) == 0


@pytest.mark.parametrize("term", TERMS)
def test_shapes_are_checked(term):
    with pytest.raises(ValueError, match="shape"):
        term(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))
    with pytest.raises(ValueError, match="mask"):
        term(torch.zeros(4, 4, 3), torch.zeros(4, 4, 3), torch.ones(5, 4, dtype=torch.bool))


@pytest.mark.parametrize("term", TERMS[:2])
def test_nor_its_gradient(term, mask):
    a, b = noise(15, 13)
    with torch.no_grad():
        a[~mask], b[~mask] = float("nan"), float("inf")
    a.requires_grad_()
    options = [{}] if term is losses.l1 else [{}, {"weights": mask[..., None].double().expand_as(b)}]
    for more in options:
        (gradient,) = torch.autograd.grad(term(a, b, mask, **more), a)
        assert (gradient[~mask] == 0).all()
        assert gradient[mask].isfinite().all() and gradient[mask].abs().min() > 0
