from __future__ import annotations

import pytest
import torch
from torch.autograd import gradcheck

from occfusion.geometry import skinning
from occfusion.geometry.rotation import quaternion_to_matrix
from occfusion.human.carry import blend_columns, carry
from occfusion.human.deform import bind


def inputs(n=5, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)

    return draw(n, 3), draw(n, 4), draw(n, 3).exp(), draw(3, 4, n), draw(n, 3), draw(3, 4, n)


def compose(means, quats, scales, rest_maps, offsets, posed_maps):
    """The same from the pure functions, left to autograd."""
    rest, posed = rest_maps.permute(2, 0, 1), posed_maps.permute(2, 0, 1)
    moved = skinning.skin_points(skinning.skin_points(means, rest) + offsets, posed)
    root = quaternion_to_matrix(quats) * scales.unsqueeze(-2)
    spread = skinning.skin_covariances(skinning.skin_covariances(root @ root.mT, rest), posed)
    return moved, spread, (posed[:, :, :3] @ rest[:, :, :3]).permute(1, 2, 0)


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-13), (torch.float32, 1e-4)])
def test_carry_and_its_gradient_equal_the_composition(dtype, bound):
    given = [t.requires_grad_() for t in inputs(50, dtype=dtype)]
    results = [function(*given) for function in (carry, compose)]
    weights = [torch.randn(t.shape, generator=torch.Generator().manual_seed(1)).to(dtype) for t in results[0]]
    gradients = []
    for result in results:
        total = sum((w * t).sum() for w, t in zip(weights, result, strict=True))
        gradients.append(torch.autograd.grad(total, given))
    for a, b in zip((*results[0], *gradients[0]), (*results[1], *gradients[1]), strict=True):
        assert a.shape == b.shape
        assert ((a - b).abs().max() / b.abs().max()) < bound


@pytest.mark.parametrize("used", [(0,), (1,), (2,), (0, 1), (0, 1, 2)])
def test_gradcheck_whatever_part_is_used(used):
    given = tuple(t.requires_grad_() for t in inputs(2, seed=3))
    assert gradcheck(lambda *x: [carry(*x)[k] for k in used], given)


def test_parts_without_gradient():
    means, quats, scales, rest_maps, offsets, posed_maps = inputs()
    means.requires_grad_()
    carry(means, quats, scales, rest_maps, offsets, posed_maps).means.sum().backward()
    want = (posed_maps[:, :3].sum(0).unsqueeze(1) * rest_maps[:, :3]).sum(0).T
    assert torch.allclose(means.grad, want)


@pytest.mark.parametrize("count", [1, 1500, 2300])
@pytest.mark.parametrize("threads", [1, 3])
def test_kernels_give_what_they_are_specified_by(count, threads):
    given = [t.requires_grad_() for t in inputs(count, seed=5, dtype=torch.float32)]
    exact = [t.detach().double().requires_grad_() for t in given]
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        results = [carry(*given), carry(*exact, compiled=False)]
        weights = [torch.randn(t.shape, generator=torch.Generator().manual_seed(1)) for t in results[0]]
        gradients = []
        for result, leaves in zip(results, (given, exact), strict=True):
            total = sum((w.to(t) * t).sum() for w, t in zip(weights, result, strict=True))
            gradients.append(torch.autograd.grad(total, leaves))
    finally:
        torch.set_num_threads(before)
    for a, b in zip((*results[0], *gradients[0]), (*results[1], *gradients[1]), strict=True):
        assert ((a.double() - b).abs().max() / b.abs().max()) < 1e-5


@pytest.mark.parametrize("used", [(0,), (1,), (2,), (0, 1)])
def test_kernels_need_no_gradient_of_what_is_not_used(used):
    given = [t.requires_grad_() for t in inputs(3, seed=6, dtype=torch.float32)]
    gradients = []
    for compiled in (True, False):
        result = carry(*given, compiled=compiled)
        total = sum(result[k].square().sum() for k in used)
        gradients.append(torch.autograd.grad(total, given, allow_unused=True))
    for a, b in zip(*gradients, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4 * float(b.abs().max()))


@pytest.mark.parametrize("needed", [(0,), (0, 1, 2), (0, 1, 2, 4), (1, 2, 5), (0, 3), (3, 4, 5)])
def test_kernels_give_the_gradients_that_are_needed(needed):
    """Frames whose poses are not mended ask for those of the Gaussians alone."""
    given = inputs(40, seed=7, dtype=torch.float32)
    gradients = []
    for compiled in (True, False):
        own = [t.clone().requires_grad_(k in needed) for k, t in enumerate(given)]
        result = carry(*own, compiled=compiled)
        sum(t.square().sum() for t in result).backward()
        gradients.append([t.grad for t in own])
    for k, (a, b) in enumerate(zip(*gradients, strict=True)):
        assert (a is not None) == (b is not None) == (k in needed)
        if b is not None:
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))


@pytest.mark.stiff
def test_extreme_quaternions_and_scales():
    _, _, _, rest_maps, offsets, posed_maps = inputs(4, dtype=torch.float32)
    quats = torch.tensor(
        [[0.0, 0, 0, 0], [1e-30, 0, 0, 0], [3e38, -3e38, 0, 0], [0, 0, 1e-6, 0]], requires_grad=True
    )
    scales = torch.tensor([[0.5, 1e-5, 1e-5]]).repeat(4, 1).requires_grad_()
    cloud = carry(torch.zeros(4, 3), quats, scales, rest_maps, offsets, posed_maps)
    want = compose(torch.zeros(4, 3), quats, scales, rest_maps, offsets, posed_maps)[1]
    assert torch.allclose(cloud.covariances, want, rtol=1e-4, atol=1e-6)
    cloud.covariances.sum().backward()
    assert torch.isfinite(quats.grad).all() and torch.isfinite(scales.grad).all()
    assert not quats.grad[:2].any()


def test_blended_columns_and_binding():
    generator = torch.Generator().manual_seed(4)
    weights = torch.softmax(torch.randn(6, 24, generator=generator, dtype=torch.float64), dim=1)
    transforms = torch.randn(24, 4, 4, generator=generator, dtype=torch.float64)
    shift = torch.tensor([1.0, 2, 3], dtype=torch.float64)
    want = skinning.blend(weights, transforms)
    want[:, :, 3] += shift
    assert torch.allclose(blend_columns(weights, transforms, shift).permute(2, 0, 1), want, atol=1e-14)
    binding = bind(weights, transforms)
    points = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    posed = skinning.skin_points(points, skinning.blend(weights, transforms))
    assert torch.allclose(skinning.skin_points(posed, binding.rest_maps.permute(2, 0, 1)), points, atol=1e-9)
