"""Score distillation against closed forms; no network."""

import pytest
import torch
from torch import Tensor

from occfusion.observation.crop import PersonView
from occfusion.priors.distillation import guided, surrogate, time_at, weight
from occfusion.priors.score import Draw, ScorePrior, distil

SIZE = 6


class GaussianScore(ScorePrior[None]):
    """The exact score of occupancies that are normal, each pixel by itself: `N(mean, spread^2)`."""

    name = "gaussian"
    size = SIZE
    signal_shape = (1, SIZE, SIZE)
    device = torch.device("cpu")

    def __init__(self, mean: Tensor, spread: float) -> None:
        self.mean, self.spread, self.asked = mean, spread, 0

    def describe(self) -> dict[str, object]:
        return {"prior": self.name}

    def encode_conditions(self, view: PersonView) -> None:
        return None

    def encode(self, occupancy: Tensor) -> Tensor:
        return 2.0 * occupancy - 1.0

    def levels(self, t: float) -> tuple[float, float]:
        angle = torch.tensor(0.5 * torch.pi * t, dtype=torch.float64)
        return float(angle.cos()), float(angle.sin())

    def predict_noise(self, noisy: Tensor, t: float, conditions: None, guidance: float) -> Tensor:
        self.asked += 1
        alpha, sigma = self.levels(t)
        return sigma * (noisy - alpha * self.mean) / (alpha**2 * self.spread**2 + sigma**2)


def occupancy_and_prior(spread: float = 0.5) -> tuple[Tensor, GaussianScore]:
    generator = torch.Generator().manual_seed(0)
    occupancy = torch.rand(SIZE, SIZE, generator=generator).requires_grad_()
    return occupancy, GaussianScore(torch.randn(1, 1, SIZE, SIZE, generator=generator), spread)


def gradient_of(prior: GaussianScore, occupancy: Tensor, mask: Tensor, draw: Draw, **options: str) -> Tensor:
    chosen = {"weighting": "sigma2", "reduction": "mean"} | options
    loss = distil(prior, occupancy, mask, None, draw, guidance=1.0, **chosen)
    (gradient,) = torch.autograd.grad(loss, occupancy)
    return gradient


@pytest.mark.parametrize("t", [0.02, 0.1, 0.5, 0.9, 0.98])
@pytest.mark.parametrize("weighting", ["sigma2", "uniform"])
@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_mean_gradient_is_the_closed_form_for_gaussian_data(t: float, weighting: str, reduction: str) -> None:
    """`w sigma alpha (x - m) / (alpha^2 s^2 + sigma^2)`; noise and its opposite leave nothing to chance."""
    occupancy, prior = occupancy_and_prior()
    mask = torch.ones(SIZE, SIZE)
    noise = torch.randn(1, 1, SIZE, SIZE, generator=torch.Generator().manual_seed(1))
    found = sum(
        0.5
        * gradient_of(prior, occupancy, mask, Draw(t, sign * noise), weighting=weighting, reduction=reduction)
        for sign in (1.0, -1.0)
    )
    alpha, sigma = prior.levels(t)
    w = sigma**2 if weighting == "sigma2" else 1.0
    x = 2.0 * occupancy.detach() - 1.0
    expected = w * sigma * alpha * (x - prior.mean[0, 0]) / (alpha**2 * prior.spread**2 + sigma**2)
    expected = 2.0 * expected / (SIZE * SIZE if reduction == "mean" else 1)
    torch.testing.assert_close(found, expected, rtol=2e-4, atol=1e-6 * float(expected.abs().max()))


def test_descent_ends_at_the_datas_mean() -> None:
    occupancy, prior = occupancy_and_prior(spread=0.1)
    target = torch.full((SIZE, SIZE), 0.7)
    prior.mean = 2.0 * target[None, None] - 1.0
    generator = torch.Generator().manual_seed(2)
    adam = torch.optim.Adam([occupancy], lr=0.02)
    for step in range(400):
        noise = torch.randn(1, 1, SIZE, SIZE, generator=generator)
        t = time_at("annealed", step / 400, 0.0, 0.02, 0.98)
        occupancy.grad = gradient_of(prior, occupancy, torch.ones(SIZE, SIZE), Draw(t, noise))
        adam.step()
    assert float((occupancy.detach() - target).abs().max()) < 0.05


def test_gradient_is_exactly_zero_outside_the_mask() -> None:
    occupancy, prior = occupancy_and_prior()
    mask = torch.zeros(SIZE, SIZE)
    mask[1:3, 2:5] = 1.0
    draw = Draw(0.5, torch.randn(1, 1, SIZE, SIZE))
    whole = gradient_of(prior, occupancy, torch.ones(SIZE, SIZE), draw)
    part = gradient_of(prior, occupancy, mask, draw)
    assert torch.equal(part[mask == 0], torch.zeros(int((mask == 0).sum())))
    assert torch.equal(part[mask == 1], whole[mask == 1])
    assert not gradient_of(prior, occupancy, torch.zeros_like(mask), draw).any()


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_surrogate_has_the_gradient_by_finite_differences(reduction: str) -> None:
    """With what is stopped held fixed, the scalar changes with the signal as the given gradient says."""
    generator = torch.Generator().manual_seed(3)
    z, g = (torch.randn(1, 2, 3, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    mask = (torch.rand(1, 1, 3, 3, generator=generator) > 0.4).float()
    leaf = z.float().requires_grad_()
    loss = surrogate(leaf, g.float(), mask, reduction)
    (found,) = torch.autograd.grad(loss, leaf)
    count = z.numel() if reduction == "mean" else 1
    torch.testing.assert_close(found, (g * mask / count).float(), rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(
        float(loss.detach()), float((g.square() * mask).sum() / 2 / count), rtol=1e-5, atol=0
    )
    held, h = (z - g), 1e-6
    for k in range(z.numel()):
        moved = [z.clone() for _ in range(2)]
        for copy, sign in zip(moved, (1, -1), strict=True):
            copy.view(-1)[k] += sign * h
        values = [float((0.5 * (copy - held).square() * mask).sum()) / count for copy in moved]
        slope = (values[0] - values[1]) / (2 * h)
        assert slope == pytest.approx(float(found.view(-1)[k]), rel=1e-4, abs=1e-7)


def test_small_gradients_and_large_weights_survive_half_precision() -> None:
    signal = torch.full((1, 1, 4, 4), 7.0, dtype=torch.float16, requires_grad=True)
    gradient = torch.full((1, 1, 4, 4), 1e-4)
    loss = 2e5 * surrogate(signal, gradient, torch.ones(1, 1, 4, 4), "mean")
    (found,) = torch.autograd.grad(loss, signal)
    torch.testing.assert_close(found.float(), torch.full((1, 1, 4, 4), 1.25), rtol=1e-3, atol=0)


@pytest.mark.stiff
@pytest.mark.parametrize("t", [0.0, 1e-6, 1.0 - 1e-6, 1.0])
def test_ends_of_time_are_finite(t: float) -> None:
    occupancy, prior = occupancy_and_prior()
    noise = torch.randn(1, 1, SIZE, SIZE)
    assert bool(gradient_of(prior, occupancy, torch.ones(SIZE, SIZE), Draw(t, noise)).isfinite().all())


def test_times() -> None:
    assert time_at("random", 0.3, 0.5, 0.0, 1.0) == 0.5
    assert time_at("annealed", 0.0, 0.5, 0.02, 0.98) == 0.98
    assert time_at("annealed", 1.0, 0.5, 0.02, 0.98) == pytest.approx(0.02)
    assert time_at("annealed", 7.0, 0.5, 0.02, 0.98) == pytest.approx(0.02)
    assert weight("sigma2", 0.5) == 0.25
    assert weight("uniform", 0.5) == 1.0


def test_guidance_goes_from_one_prediction_to_the_other() -> None:
    a, b = torch.zeros(2), torch.ones(2)
    for guidance in (0.0, 0.5, 1.0, 7.5):
        assert float(guided(a, b, guidance)[0]) == guidance


@pytest.mark.parametrize("call", [
    lambda: weight("snr", 0.5),
    lambda: time_at("cosine", 0.5, 0.5, 0.0, 1.0),
    lambda: surrogate(torch.zeros(1, 1, 2, 2), torch.zeros(1, 1, 2, 2), torch.ones(1), "max"),
    lambda: surrogate(torch.zeros(1, 1, 2, 2), torch.zeros(1, 1, 2, 3), torch.ones(1), "mean"),
])  # fmt: skip
def test_what_is_unknown_is_refused(call) -> None:
    with pytest.raises(ValueError):
        call()
