"""Pictures that are filled up to a few sizes have the terms of the pictures themselves."""

from __future__ import annotations

import pytest
import torch

from occfusion.quality import losses, recorded


@pytest.mark.parametrize(("height", "width"), [(40, 59), (59, 22), (60, 123), (64, 64), (130, 70)])
@pytest.mark.parametrize("margin", [0, 2])
def test_terms_and_gradients_of_the_pictures_themselves(height: int, width: int, margin: int) -> None:
    """Masks reach the border, where SSIM sees what is mirrored."""
    generator = torch.Generator().manual_seed(height + width)
    a, b = (torch.rand(height, width, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    mask = torch.rand(height, width, generator=generator) > 0.1
    mask[: height // 3, : width // 3] = False
    inner = losses.within(mask, margin)
    a.requires_grad_()
    wanted = losses.l1(a, b, mask), losses.masked_ssim_loss(a, b, inner)
    planes, masks = recorded.filled(a, b, mask, inner)
    assert all(side % recorded.STEP == 0 for side in planes.shape[1:])
    found = recorded.of_filled(planes, masks)
    for ours, theirs in zip(found, wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-14)
        gradients = [torch.autograd.grad(term, a, retain_graph=True)[0] for term in (ours, theirs)]
        torch.testing.assert_close(*gradients, rtol=1e-10, atol=1e-14)


def test_no_pixel_in_the_masks() -> None:
    a = torch.rand(30, 30, 3, requires_grad=True)
    nothing = torch.zeros(30, 30, dtype=torch.bool)
    found = recorded.of_filled(*recorded.filled(a, torch.rand(30, 30, 3), nothing, nothing))
    assert [float(term.detach()) for term in found] == [0.0, 0.0]
    assert not torch.autograd.grad(sum(found), a)[0].any()


@pytest.mark.parametrize("margin", [1, 2, 5])
def test_the_inside_of_a_mask_by_pooling(margin: int) -> None:
    """What lies outside of the picture has no edge there."""
    generator = torch.Generator().manual_seed(margin)
    for share in (0.0, 0.05, 0.5):
        mask = torch.rand(23, 31, generator=generator) >= share
        assert torch.equal(losses._within_by_pooling(mask, margin), losses.within(mask, margin))
