from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from occfusion.perceptual import PerceptualMetric, load_perceptual
from occfusion.perceptual.network import layer_shapes
from occfusion.perceptual.weights import MetricWeights, load_stlpips
from oracles import quality as oracle
from quality.pictures import noise, waves

# Printed by stlpips_pytorch 0.0.2 itself, LPIPS(net="vgg", variant="shift_tolerant")(a, b, normalize=True) in
# float32 on torch 2.13 (CPU), for quality.pictures.waves: with b, with black, and without normalize=True.
REFERENCE = {
    (64, 64): (0.316506237, 0.874122918, 0.227429733),
    (96, 80): (0.309404403, 0.913593769, 0.264713705),
    (33, 57): (0.164707124, 0.792846859, 0.117421262),
    (18, 18): (0.062930949, 0.483148754, 0.0267859343),
}


@pytest.fixture(scope="module")
def random_weights() -> MetricWeights:
    """An untrained VGG16 that keeps the size of its activations."""
    generator = torch.Generator().manual_seed(0)
    convolutions = {
        name: (
            torch.randn(shape, generator=generator) * (2 / (9 * shape[1])) ** 0.5,
            0.1 * torch.randn(shape[0], generator=generator),
        )
        for name, shape in layer_shapes().items()
    }
    heads = [torch.rand(c, generator=generator) for c in (64, 128, 256, 512, 512)]
    return MetricWeights(convolutions, heads)


@pytest.mark.parametrize("size", list(REFERENCE))
def test_stlpips_gives_the_reference_packages_values(stlpips, size):
    a, b = waves(*size)
    near, black, _ = REFERENCE[size]
    assert float(stlpips(a, b)) == pytest.approx(near, rel=2e-6)
    assert float(stlpips(a, torch.zeros_like(a))) == pytest.approx(black, rel=2e-6)


def test_the_unnormalised_call_has_its_own_name_and_the_reference_packages_values():
    metric = load_perceptual("stlpips", centred=False)
    assert metric.name == "ST-LPIPS (VGG, inputs 0..1)"
    a, b = waves(64, 64)
    assert float(metric(a, b)) == pytest.approx(REFERENCE[64, 64][2], rel=2e-6)


@pytest.mark.parametrize(("antialiased", "size"), [(True, (18, 23)), (False, (17, 22))])
def test_network_and_distance_from_the_formulas(random_weights, antialiased, size):
    metric = PerceptualMetric("test", random_weights, antialiased=antialiased)
    a, b = noise(*size)
    arrays = [(w.numpy().astype(np.float64), c.numpy()) for w, c in random_weights.convolutions.values()]
    heads = [h.numpy() for h in random_weights.heads]
    pictures = [2 * p.numpy() - 1 for p in (a, b)]
    expected = oracle.perceptual_distance(*pictures, arrays, heads, blurred=antialiased)
    assert float(metric(a.float(), b.float())) == pytest.approx(expected, rel=1e-5)


def test_gradient_is_the_slope_in_random_directions(random_weights):
    metric = PerceptualMetric("test", random_weights, antialiased=True).double()
    a, b = noise(18, 19)
    a = 0.1 + 0.8 * a  # away from the clamp
    a.requires_grad_()
    metric(a, b).backward()
    for seed in range(3):
        direction = noise(18, 19, seed=seed + 10)[0] - 0.5
        step = 1e-6 * direction
        with torch.no_grad():
            slope = (metric(a + step, b) - metric(a - step, b)) / 2e-6
        assert float((a.grad * direction).sum()) == pytest.approx(float(slope), rel=1e-5)


def test_equal_pictures_have_no_distance_and_order_matters_not(stlpips):
    a, b = waves(32, 40)
    assert stlpips(a, a.clone()) == 0
    assert float(stlpips(a, b)) == pytest.approx(float(stlpips(b, a)), rel=1e-6)


def test_blur_is_punished_and_a_shift_by_a_pixel_hardly(stlpips):
    picture = noise(64, 64, dtype=torch.float32)[0]
    planes = picture.permute(2, 0, 1)[None]
    picture = torch.nn.functional.interpolate(planes[..., :22, :22], size=(64, 64), mode="bilinear")[
        0
    ].permute(1, 2, 0)
    shifted = picture.roll(1, dims=1)
    blurred = torch.nn.functional.avg_pool2d(picture.permute(2, 0, 1), 7, 1, 3).permute(1, 2, 0)
    assert stlpips(picture, shifted) < 0.5 * stlpips(picture, blurred)


def test_a_kept_target_gives_the_same(stlpips):
    a, b = waves(40, 32)
    kept = stlpips.features(b)
    assert stlpips.distance(a, kept) == stlpips(a, b)
    with pytest.raises(ValueError, match="another size"):
        stlpips.distance(a[:20], kept)


@pytest.mark.parametrize("antialiased", [True, False])
def test_all_that_it_needs_moves_to_another_device_with_it(random_weights, antialiased):
    """`meta` computes no values, but refuses operands of two devices as a GPU does."""
    metric = PerceptualMetric("test", random_weights, antialiased=antialiased).to("meta")
    a = torch.empty(70, 64, 3, device="meta", requires_grad=True)
    distance = metric(a, torch.empty(70, 64, 3, device="meta"))
    (gradient,) = torch.autograd.grad(distance, a)
    assert distance.device.type == gradient.device.type == "meta"
    assert metric.over_black(a, a.detach()).device.type == "meta"


def test_frozen(stlpips):
    assert not list(stlpips.parameters())
    a, b = waves(20, 20)
    before = float(stlpips(a, b))
    stlpips.train()
    assert float(stlpips(a, b)) == before


@pytest.mark.stiff
@pytest.mark.parametrize("value", [0.0, 1.0])
def test_flat_pictures_have_finite_gradients_under_anomaly_detection(stlpips, value):
    a = torch.full((20, 20, 3), value, requires_grad=True)
    with torch.autograd.set_detect_anomaly(True):
        stlpips(a, torch.rand(20, 20, 3)).backward()
    assert a.grad.isfinite().all()
    assert (a.grad != 0).any()


@pytest.mark.stiff
def test_dead_features_have_a_gradient_of_zero_not_nan(random_weights):
    dead = {name: (w, torch.full_like(c, -1e6)) for name, (w, c) in random_weights.convolutions.items()}
    metric = PerceptualMetric("test", MetricWeights(dead, random_weights.heads), antialiased=True)
    a = torch.rand(20, 20, 3, requires_grad=True)
    with torch.autograd.set_detect_anomaly(True):
        metric(a, torch.rand(20, 20, 3)).backward()
    assert (a.grad == 0).all()


@pytest.mark.parametrize("size", [(1, 1), (5, 40), (17, 18)])
def test_short_sides_are_filled_up_with_black(stlpips, size):
    a, b = noise(*size, dtype=torch.float32)
    a.requires_grad_()
    value = stlpips(a, b)
    value.backward()
    assert a.grad.shape == a.shape and a.grad.isfinite().all()
    padded = [torch.zeros(max(18, size[0]), max(18, size[1]), 3) for _ in range(2)]
    for large, small in zip(padded, (a, b), strict=True):
        large[: size[0], : size[1]] = small.detach()
    assert value.item() == pytest.approx(float(stlpips(*padded)), rel=1e-6)


def test_colours_outside_the_range_are_clamped_without_gradient(stlpips):
    a, b = noise(20, 20, dtype=torch.float32)
    a[3, 3], a[5, 5] = 1.7, -0.4
    a.requires_grad_()
    value = stlpips(a, b)
    assert value == stlpips(a.detach().clamp(0, 1), b)
    value.backward()
    assert (a.grad[3, 3] == 0).all() and (a.grad[5, 5] == 0).all()


def test_inference_mode(stlpips):
    a, b = noise(20, 20, dtype=torch.float32)
    outside = float(stlpips(a, b))
    with torch.inference_mode():
        assert float(stlpips(a, b)) == outside


def test_wrong_pictures_are_refused(stlpips):
    with pytest.raises(ValueError, match="H, W, 3"):
        stlpips(torch.rand(20, 20), torch.rand(20, 20))
    with pytest.raises(ValueError, match="shape"):
        stlpips(torch.rand(20, 20, 3), torch.rand(20, 21, 3))


def test_the_package_with_the_weights_is_never_imported(stlpips):
    assert stlpips.name == "ST-LPIPS (VGG)"
    assert not {"stlpips_pytorch", "torchvision", "IPython"} & set(sys.modules)


def test_heads_are_not_negative():
    weights = load_stlpips()
    assert all((head >= 0).all() for head in weights.heads)
