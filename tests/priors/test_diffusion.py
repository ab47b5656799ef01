"""The sampler against problems whose posterior is known in closed form."""

import math
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from occfusion.priors.embedded.diffusion import (
    alpha_sigma,
    clean_and_noise,
    diffuse,
    posterior_mean,
    sample,
    velocity,
)

MEAN, SPREAD = 0.3, 0.2


def gaussian_v(x: Tensor, t: Tensor) -> Tensor:
    """Returns the exact prediction of v for data N(MEAN, SPREAD^2): E[v | x_t] by the Gaussian posterior."""
    alpha, sigma = (part.reshape(-1, 1, 1, 1) for part in alpha_sigma(t))
    variance = alpha**2 * SPREAD**2 + sigma**2
    clean = MEAN + alpha * SPREAD**2 / variance * (x - alpha * MEAN)
    noise = sigma / variance * (x - alpha * MEAN)
    return alpha * noise - sigma * clean


@pytest.mark.parametrize("t", [0.0, 1e-6, 0.3, 0.9, 1.0])
def test_velocity_and_noisy_signal_determine_clean_and_noise(t: float) -> None:
    generator = torch.Generator().manual_seed(0)
    clean, noise = (torch.randn(2, 1, 3, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    time = torch.full((2,), t, dtype=torch.float64)
    back = clean_and_noise(diffuse(clean, noise, time), velocity(clean, noise, time), time)
    torch.testing.assert_close(back[0], clean, rtol=0, atol=1e-12)
    torch.testing.assert_close(back[1], noise, rtol=0, atol=1e-12)


def test_variance_is_preserved() -> None:
    alpha, sigma = alpha_sigma(torch.linspace(0, 1, 11, dtype=torch.float64))
    torch.testing.assert_close(alpha**2 + sigma**2, torch.ones(11, dtype=torch.float64))


def test_samples_of_a_gaussian_have_its_mean_and_spread() -> None:
    torch.manual_seed(0)
    noise = torch.randn(1, 1, 150, 150, dtype=torch.float64)
    found = sample(gaussian_v, noise, 200)
    assert float(found.mean()) == pytest.approx(MEAN, abs=0.01)
    assert float(found.std()) == pytest.approx(SPREAD, rel=0.02)


def test_deterministic_sampler_is_the_map_between_gaussians() -> None:
    # the flow of the ordinary differential equation carries quantiles to quantiles
    noise = torch.linspace(-2, 2, 9, dtype=torch.float64).reshape(1, 1, 3, 3)
    found = sample(gaussian_v, noise, 400)
    torch.testing.assert_close(found, MEAN + SPREAD * noise, rtol=0, atol=4e-3)


def test_sampler_converges_at_first_order() -> None:
    noise = torch.linspace(-2, 2, 9, dtype=torch.float64).reshape(1, 1, 3, 3)
    errors = [float((sample(gaussian_v, noise, n) - MEAN - SPREAD * noise).abs().max()) for n in (20, 40, 80)]
    for coarse, fine in pairwise(errors):
        assert 1.6 < coarse / fine < 2.6


def test_posterior_mean_is_the_mean_whatever_the_noise() -> None:
    noise = torch.randn(3, 1, 4, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(posterior_mean(gaussian_v, noise), torch.full_like(noise, MEAN))


def test_same_noise_same_sample_and_steps_are_checked() -> None:
    noise = torch.randn(1, 1, 4, 4)
    assert torch.equal(sample(gaussian_v, noise, 5), sample(gaussian_v, noise, 5))
    with pytest.raises(ValueError, match="steps"):
        sample(gaussian_v, noise, 0)


def test_samples_stay_in_range_for_a_wild_network() -> None:
    found = sample(lambda x, t: 1e3 * x, torch.randn(1, 1, 8, 8), 10)
    assert bool(torch.isfinite(found).all())
    assert float(found.abs().max()) <= 1.0
    assert math.isfinite(float(posterior_mean(lambda x, t: 1e30 * x, torch.ones(1, 1, 2, 2)).sum()))
