"""Dividing Gaussians: mean, covariance and covered area stay, and so, nearly, does the picture."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from occfusion.geometry.rotation import quaternion_to_matrix
from occfusion.human import Gaussians, editing
from occfusion.human.densify import Densification, Densifier
from occfusion.human.gaussians import PARAMETERS
from occfusion.splat import rasterize
from occfusion.splat.harmonics import SH_C0
from oracles.rotation import conjugate


def made(count: int, dtype: torch.dtype = torch.float64, spread: float = 1.0) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    means = spread * torch.randn(count, 3, generator=generator, dtype=dtype)
    gaussians = Gaussians(means, torch.full((count, 3), 0.05, dtype=dtype), 1)
    with torch.no_grad():
        for name in PARAMETERS[1:]:
            value = getattr(gaussians, name)
            value.add_(torch.randn(value.shape, generator=generator, dtype=dtype), alpha=0.6)
        gaussians.opacity_logits.add_(2.0)
    return gaussians


def covariance(values: dict[str, torch.Tensor], n: int) -> np.ndarray:
    root = conjugate(values["raw_quats"][n].numpy()) @ np.diag(np.exp(values["log_scales"][n].numpy()))
    return root @ root.T


def test_two_halves_have_the_mean_and_covariance_of_the_whole() -> None:
    population = editing.read(made(12), None)
    chosen = torch.arange(12) % 3 == 0
    divided = editing.edit_divide(population, chosen)
    kept, halves = int((~chosen).sum()), int(chosen.sum())
    assert divided.size == kept + 2 * halves
    for name in PARAMETERS:
        assert torch.equal(divided.values[name][:kept], population.values[name][~chosen])
    for place, row in enumerate(chosen.nonzero()[:, 0].tolist()):
        pair = (kept + place, kept + halves + place)
        a, b = (divided.values["means"][n].numpy() for n in pair)
        mean = (a + b) / 2
        assert_close(mean, population.values["means"][row].numpy(), atol=1e-12, rtol=0)
        total = sum(covariance(divided.values, n) for n in pair) / 2
        total = total + (np.outer(a - mean, a - mean) + np.outer(b - mean, b - mean)) / 2
        assert_close(total, covariance(population.values, row), atol=1e-12, rtol=1e-9)
        # both within the ellipsoid of one standard deviation
        inside = (a - mean) @ np.linalg.solve(covariance(population.values, row), a - mean)
        assert inside == pytest.approx(editing.DIVIDED_BY**2)
        for name in ("raw_quats", "sh0", "sh_rest"):
            for n in pair:
                assert torch.equal(divided.values[name][n], population.values[name][row])


@pytest.mark.parametrize(
    ("opacity", "narrower"),
    [(0.005, 1.0), (0.1, 1.0), (0.5, 1.0), (0.9, 1.0), (0.999, 1.0), (0.005, 1.5), (0.5, 1.5), (0.9, 1.5)],
)
def test_two_halves_cover_the_area_of_the_whole(opacity: float, narrower: float) -> None:
    """By a sum over a fine grid of what light they hold back, one behind the other."""
    gaussians = made(1)
    with torch.no_grad():
        gaussians.log_scales.copy_(torch.tensor([[0.3, 1.0, 0.2]]).log() * 0.5)
        gaussians.opacity_logits.fill_(math.log(opacity / (1 - opacity)))
    divided = editing.edit_divide(editing.read(gaussians, None), torch.ones(1, dtype=torch.bool), narrower)
    half = float(divided.values["opacity_logits"].sigmoid()[0])
    long, short = 1.0, 0.3
    x, y = np.meshgrid(np.linspace(-8, 8, 801), np.linspace(-3, 3, 601))

    def bell(at: float, length: float, width: float) -> np.ndarray:
        return np.exp(-(((x - at) / length) ** 2) / 2 - (y / width) ** 2 / 2)

    apart, length = editing.DIVIDED_BY * long, long * math.sqrt(1 - editing.DIVIDED_BY**2)
    whole = (opacity * bell(0.0, long, short)).sum()
    halves = (half * bell(side * apart, length, short / narrower) for side in (-1, 1))
    both = (1 - (1 - next(halves)) * (1 - next(halves))).sum()
    assert both == pytest.approx(whole, rel=1e-6)


def test_opaque_ones_that_become_narrower_stay_opaque() -> None:
    """They would have to be more than that to cover the same; without a bound that would be no number."""
    gaussians = made(2, torch.float32)
    with torch.no_grad():
        gaussians.opacity_logits.copy_(torch.tensor([9.0, 40.0]))
    divided = editing.edit_divide(editing.read(gaussians, None), torch.ones(2, dtype=torch.bool), 3.0)
    assert bool((divided.values["opacity_logits"] > 5.0).all())
    assert bool(torch.isfinite(divided.values["opacity_logits"]).all())
    whole, parts = gaussians.log_scales.detach(), divided.values["log_scales"]
    across = whole.argsort(dim=1)[:, :2]
    apart = whole.gather(1, across) - parts[:2].gather(1, across)
    assert torch.allclose(apart, torch.full_like(apart, math.log(3.0)), atol=1e-5)


def test_halves_start_without_momentum_and_with_the_second_moment_of_the_whole() -> None:
    gaussians = made(5)
    optimizer = torch.optim.Adam([{"params": [getattr(gaussians, name)], "lr": 0.01} for name in PARAMETERS])
    sum((getattr(gaussians, name) ** 3).sum() for name in PARAMETERS).backward()
    optimizer.step()
    population = editing.read(gaussians, optimizer)
    divided = editing.edit_divide(population, torch.tensor([False, True, False, False, True]))
    for name in PARAMETERS:
        before, after = population.moments[name], divided.moments[name]
        assert torch.equal(after["exp_avg"][3:], torch.zeros_like(after["exp_avg"][3:]))
        assert torch.equal(after["exp_avg_sq"][3:], before["exp_avg_sq"][[1, 4, 1, 4]])
        assert torch.equal(after["exp_avg"][:3], before["exp_avg"][[0, 2, 3]])


def picture(values: dict[str, torch.Tensor]) -> torch.Tensor:
    size = 96
    K = torch.tensor([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[2, 3] = 3.0
    roots = quaternion_to_matrix(values["raw_quats"]) * values["log_scales"].exp()[:, None]
    return rasterize(
        values["means"], None, None, values["opacity_logits"].sigmoid(),
        (0.5 + SH_C0 * values["sh0"][:, 0]).clamp(0, 1), viewmat, K, size, size,
        covariances=roots @ roots.transpose(1, 2), backend="torch",
    ).rgb  # fmt: skip


def test_the_picture_stays_where_cloning_and_splitting_change_it() -> None:
    population = editing.read(made(400, spread=0.4), None)
    chosen = torch.arange(400) % 2 == 0
    before = picture(population.values)
    generator = torch.Generator().manual_seed(0)

    def change(edited: editing.Population) -> float:
        return float((picture(edited.values) - before).square().mean().sqrt())

    divided = change(editing.edit_divide(population, chosen))
    cloned = change(editing.edit_clone(population, chosen, generator))
    split = change(editing.edit_split(population, chosen, generator))
    assert divided < 0.03
    assert divided < 0.4 * min(cloned, split)


def test_a_round_divides(body) -> None:
    from occfusion.human import Avatar
    from occfusion.types import Camera

    def round_of(divide: bool):
        avatar = Avatar(body, sh_degree=0, refine_pose=False, learn_skinning=False)
        with torch.no_grad():
            avatar.gaussians.opacity_logits.fill_(2.0)
        densifier = Densifier(Densification(min_gaussians=1, from_body=9.0, divide=divide))
        gradient = torch.zeros(avatar.gaussians.num_gaussians, 2, dtype=torch.float64)
        gradient[3:9] = 1.0
        densifier.observe(gradient, torch.ones_like(gradient), Camera(torch.eye(4), torch.eye(3), 400, 300))
        done = densifier.step(600, avatar, None)
        return done, avatar.gaussians.opacities

    divided, opacities = round_of(True)
    drawn, others = round_of(False)
    assert divided.cloned + divided.split == drawn.cloned + drawn.split > 0
    assert divided.total == drawn.total
    assert opacities.min() < 0.75 and others.min() > 0.85  # of 0.88
