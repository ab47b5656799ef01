from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from occfusion.human import Gaussians, editing
from occfusion.human.gaussians import PARAMETERS
from oracles.rotation import conjugate
from oracles.skinning import kl


def make(n=8, seed=0, degree=1, stepped=True):
    generator = torch.Generator().manual_seed(seed)
    gaussians = Gaussians(
        torch.randn(n, 3, generator=generator).double(), torch.full((n, 3), 0.02).double(), degree
    )
    with torch.no_grad():
        for name in PARAMETERS[1:]:
            value = getattr(gaussians, name)
            value.add_(torch.randn(value.shape, generator=generator), alpha=0.5)
    groups = [{"name": name, "params": [getattr(gaussians, name)], "lr": 0.01} for name in PARAMETERS]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    if stepped:
        for _ in range(3):
            optimizer.zero_grad()
            sum((getattr(gaussians, name) ** 3).sum() for name in PARAMETERS).backward()
            optimizer.step()
    return gaussians, optimizer


def covariance(values, n):
    root = conjugate(values["raw_quats"][n].numpy()) @ np.diag(np.exp(values["log_scales"][n].numpy()))
    return root @ root.T


def flags(n, *chosen):
    chosen_flags = torch.zeros(n, dtype=torch.bool)
    chosen_flags[list(chosen)] = True
    return chosen_flags


def test_kl_equals_the_matrix_formula_and_a_sample_mean():
    values = editing.read(*make(6)).values
    first, second = torch.tensor([0, 1, 2, 3]), torch.tensor([1, 0, 5, 3])
    got = editing.kl_divergence(values, first, second)
    for value, a, b in zip(got.tolist(), first.tolist(), second.tolist(), strict=True):
        want = kl(
            values["means"][a].numpy(),
            covariance(values, a),
            values["means"][b].numpy(),
            covariance(values, b),
        )
        assert value == pytest.approx(want, rel=1e-9, abs=1e-12)
    assert float(got[3]) == pytest.approx(0.0, abs=1e-12)


def test_kl_equals_a_sample_mean():
    values = editing.read(*make(2)).values
    values["means"][1] = values["means"][0] + 0.01
    a, b = (
        torch.distributions.MultivariateNormal(values["means"][n], torch.tensor(covariance(values, n)))
        for n in (0, 1)
    )
    torch.manual_seed(0)
    draws = a.sample((200_000,))
    sampled = (a.log_prob(draws) - b.log_prob(draws)).mean()
    exact = editing.kl_divergence(values, torch.tensor([0]), torch.tensor([1]))
    assert float(exact) == pytest.approx(float(sampled), rel=0.02)


def test_keep_carries_values_and_moments():
    population = editing.read(*make())
    kept = editing.edit_keep(population, flags(8, 1, 5, 6))
    for name in PARAMETERS:
        assert torch.equal(kept.values[name], population.values[name][[1, 5, 6]])
        for moment in editing.MOMENTS:
            assert torch.equal(kept.moments[name][moment], population.moments[name][moment][[1, 5, 6]])


def test_clone_appends_copies_drawn_from_their_parents():
    population = editing.read(*make())
    cloned = editing.edit_clone(population, flags(8, 2, 7), torch.Generator().manual_seed(3))
    assert cloned.size == 10
    noise = torch.randn(2, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    for row, parent in enumerate((2, 7)):
        old = {name: population.values[name][parent].numpy() for name in PARAMETERS}
        want = old["means"] + conjugate(old["raw_quats"]) @ (np.exp(old["log_scales"]) * noise[row].numpy())
        assert np.allclose(cloned.values["means"][8 + row], want, atol=1e-14)
        for name in PARAMETERS[1:]:
            assert np.array_equal(cloned.values[name][8 + row], old[name])
        for name in PARAMETERS:
            assert not cloned.moments[name]["exp_avg"][8 + row].any()
            second = population.moments[name]["exp_avg_sq"]
            assert torch.equal(cloned.moments[name]["exp_avg_sq"][8 + row], second[parent])
            assert torch.equal(cloned.moments[name]["exp_avg"][:8], population.moments[name]["exp_avg"])


def test_split_replaces_by_two_smaller_ones():
    population = editing.read(*make())
    split = editing.edit_split(population, flags(8, 0, 4), torch.Generator().manual_seed(1))
    stay = [1, 2, 3, 5, 6, 7]
    assert split.size == 10
    for name in PARAMETERS:
        assert torch.equal(split.values[name][:6], population.values[name][stay])
        assert torch.equal(split.moments[name]["exp_avg"][:6], population.moments[name]["exp_avg"][stay])
    for row, parent in ((6, 0), (7, 4), (8, 0), (9, 4)):
        want = population.values["log_scales"][parent] - math.log(1.6)
        assert torch.allclose(split.values["log_scales"][row], want, atol=1e-14)
        assert not split.moments["means"]["exp_avg"][row].any()
        assert torch.equal(
            split.moments["means"]["exp_avg_sq"][row], population.moments["means"]["exp_avg_sq"][parent]
        )
    again = editing.edit_split(population, flags(8, 0, 4), torch.Generator().manual_seed(1))
    assert torch.equal(split.values["means"], again.values["means"])


def test_merge_keeps_the_pairs_moments_of_mass():
    population = editing.read(*make())
    merged = editing.edit_merge(population, torch.tensor([[1, 3], [6, 0]]))
    assert merged.size == 6
    for row, (a, b) in ((4, (1, 3)), (5, (6, 0))):
        old = {name: population.values[name].numpy() for name in PARAMETERS}
        oa, ob = (1 / (1 + np.exp(-old["opacity_logits"][n])) for n in (a, b))
        wa, wb = oa / (oa + ob), ob / (oa + ob)
        mean = wa * old["means"][a] + wb * old["means"][b]
        da, db = old["means"][a] - mean, old["means"][b] - mean
        spread = wa * (covariance(population.values, a) + np.outer(da, da))
        spread = spread + wb * (covariance(population.values, b) + np.outer(db, db))
        assert np.allclose(merged.values["means"][row], mean, atol=1e-14)
        scale = np.exp(merged.values["log_scales"][row].numpy())
        if np.linalg.eigvalsh(spread)[-1] < 0.25:  # else the bound of half a metre cuts in
            assert np.allclose(covariance(merged.values, row), spread, atol=1e-12)
        else:
            assert scale.max() == pytest.approx(0.5)
        assert 1 / (1 + math.exp(-merged.values["opacity_logits"][row])) == pytest.approx(
            1 - (1 - oa) * (1 - ob)
        )
        assert np.allclose(merged.values["sh0"][row], wa * old["sh0"][a] + wb * old["sh0"][b])
        second = population.moments["sh0"]["exp_avg_sq"].numpy()
        assert np.allclose(merged.moments["sh0"]["exp_avg_sq"][row], (second[a] + second[b]) / 2)
        assert not merged.moments["sh0"]["exp_avg"][row].any()


def test_merging_equal_halves_undoes_them():
    """Two Gaussians at one place with opacity 1 - sqrt(1 - o) look like one with o, and merge into it."""
    population = editing.read(*make(stepped=False))
    values = {name: value[:1].repeat_interleave(2, dim=0) for name, value in population.values.items()}
    opacity = values["opacity_logits"].sigmoid()
    half = 1 - (1 - opacity).sqrt()
    halves = editing.Population({**values, "opacity_logits": half.logit()}, {})
    merged = editing.edit_merge(halves, torch.tensor([[0, 1]]))
    assert np.allclose(covariance(merged.values, 0), covariance(population.values, 0), atol=1e-15)
    for name in ("means", "opacity_logits", "sh0", "sh_rest"):
        assert torch.allclose(merged.values[name], population.values[name][:1], atol=1e-12), name


@pytest.mark.stiff
def test_merging_thin_and_opaque_gaussians_stays_finite_and_right_handed():
    gaussians, _ = make(40, stepped=False)
    with torch.no_grad():
        gaussians.log_scales.copy_(torch.tensor([0.4, 1e-5, 1e-5]).log().double())
        gaussians.opacity_logits.fill_(1e4)
    population = editing.read(gaussians, None)
    merged = editing.edit_merge(population, torch.arange(40).view(20, 2))
    for name in PARAMETERS:
        assert torch.isfinite(merged.values[name]).all()
    assert torch.equal(
        editing.edit_merge(population, torch.zeros(0, 2, dtype=torch.int64)).values["means"], gaussians.means
    )


@pytest.mark.parametrize("stepped", [True, False])
def test_write_exchanges_parameters_in_module_and_optimiser(stepped):
    gaussians, optimizer = make(stepped=stepped)
    before = editing.read(gaussians, optimizer)
    population = editing.edit_clone(before, flags(8, 0), torch.Generator().manual_seed(0))
    editing.write(population, gaussians, torch.arange(9), optimizer)
    assert gaussians.vertex_index.tolist() == list(range(9))
    for group in optimizer.param_groups:
        assert group["params"] == [getattr(gaussians, group["name"])]
        assert group["params"][0].shape[0] == 9
    assert len(optimizer.state) == (len(PARAMETERS) if stepped else 0)
    if stepped:
        state = optimizer.state[gaussians.means]
        assert float(state["step"]) == 3
        assert torch.equal(state["exp_avg"][:8], before.moments["means"]["exp_avg"])
    optimizer.zero_grad()
    (gaussians.means**2).sum().backward()
    optimizer.step()
    assert torch.isfinite(gaussians.means).all()


@pytest.mark.stiff
def test_first_step_of_a_new_gaussian_is_no_leap():
    """With a second moment of zero it would be about three learning rates long, whatever the gradient."""
    gaussians, optimizer = make(stepped=False)
    for _ in range(300):
        optimizer.zero_grad()
        gaussians.means.sum().backward()
        optimizer.step()
    population = editing.edit_clone(editing.read(gaussians, optimizer), flags(8, 0, 1), torch.Generator())
    editing.write(population, gaussians, torch.zeros(10), optimizer)
    before = gaussians.means.detach().clone()
    optimizer.zero_grad()
    gaussians.means.sum().backward()
    optimizer.step()
    moved = (gaussians.means.detach() - before).abs().amax(dim=1) / 0.01
    assert moved[:8].max() == pytest.approx(1.0, abs=0.05)
    assert moved[8:].max() < 1.0
