"""Fusion of the silhouette prior's answer with the body mesh, and the logistic regression under it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from occfusion.priors.embedded.body_fusion import BodyFusion, fusion_features, identity, usable
from occfusion.priors.embedded.conditions import Conditions
from occfusion.priors.embedded.silhouette_net import SilhouetteNet
from occfusion.priors.logistic import fit_logistic, sigmoid

SIZE = 64


def disc(x: float, y: float = 32.0, radius: float = 18.0) -> Tensor:
    """Returns a disc, 0 or 1, `[1, 1, SIZE, SIZE]`."""
    rows, columns = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    return (((columns - x) ** 2 + (rows - y) ** 2) < radius**2).float()[None, None]


def crop(person: Tensor, body: Tensor, hidden: Tensor) -> Conditions:
    """Returns what is known of a person behind an occluder."""
    known = 1.0 - hidden
    limbs = torch.zeros(1, 7, SIZE // 4, SIZE // 4)
    return Conditions(person * known, (1.0 - person) * known, torch.cat([body, body], dim=1), limbs)


def right_half() -> Tensor:
    """Returns an occluder over the right half."""
    hidden = torch.zeros(1, 1, SIZE, SIZE)
    hidden[..., SIZE // 2 :] = 1.0
    return hidden


def careful(person: Tensor, generator: torch.Generator) -> Tensor:
    """Returns an answer that is right on average only: the person somewhat shifted, and pale."""
    shift = int(torch.randint(-4, 5, (1,), generator=generator))
    return 0.6 * (2.0 * person.roll(shift, dims=3) - 1.0)


def people(count: int, seed: int) -> list[tuple[Tensor, Conditions, Tensor, bool]]:
    """Returns answers, conditions, truths, and whether the body is exact: it is for every second one."""
    generator = torch.Generator().manual_seed(seed)
    found = []
    for k in range(count):
        person = disc(32.0 + float(torch.randn(1, generator=generator)))
        off = 0 if k % 2 == 0 else int(torch.tensor([-7, 7])[k // 2 % 2])
        body = person.roll(off, dims=3)
        found.append((careful(person, generator), crop(person, body, right_half()), 2 * person - 1, off == 0))
    return found


def iou(completed: Tensor, clean: Tensor) -> float:
    """Returns the IoU inside the hidden half."""
    a, b = (completed > 0.5)[..., SIZE // 2 :], (clean > 0)[..., SIZE // 2 :]
    return float((a & b).sum() / (a | b).sum())


def fitted() -> BodyFusion:
    """Returns a fusion fitted on some people."""
    fusion = BodyFusion()
    fusion.fit([row[:3] for row in people(24, 0)])
    return fusion


def test_an_exact_body_is_believed_and_a_wrong_one_is_not() -> None:
    fusion, rows = fitted(), people(40, 1)
    fused = {
        exact: np.mean([iou(fusion(m, c), t) for m, c, t, e in rows if e == exact]) for exact in (True, False)
    }
    alone = {
        exact: np.mean([iou(0.5 + 0.5 * m, t) for m, _, t, e in rows if e == exact])
        for exact in (True, False)
    }
    body = np.mean([iou(c.body[:, :1], t) for _, c, t, e in rows if not e])
    assert fused[True] > 0.98 > alone[True] + 0.04
    assert fused[False] > alone[False] - 0.01
    assert fused[False] > body + 0.05


def test_known_pixels_keep_their_answer() -> None:
    fusion = fitted()
    mean, conditions, _, _ = people(1, 2)[0]
    known = (conditions.visible + conditions.background) > 0
    assert torch.equal(fusion(mean, conditions)[known], (0.5 + 0.5 * mean)[known])
    assert not torch.equal(fusion(mean, conditions)[~known], (0.5 + 0.5 * mean)[~known])


@pytest.mark.parametrize("missing", ["visible", "background", "body"])
def test_without_a_part_of_the_evidence_the_answer_stands(missing: str) -> None:
    mean, conditions, _, _ = people(1, 3)[0]
    assert usable(conditions) == [0]
    lacking = conditions.without(missing)
    assert usable(lacking) == []
    assert torch.equal(fitted()(mean, lacking), 0.5 + 0.5 * mean)


def test_unfitted_it_changes_nothing_and_its_weights_say_so() -> None:
    mean, conditions, _, _ = people(1, 4)[0]
    assert torch.equal(BodyFusion()(mean, conditions), 0.5 + 0.5 * mean)
    features, hidden = fusion_features(mean, conditions)
    by_weights = torch.sigmoid(features @ identity().flatten())
    torch.testing.assert_close(by_weights, (0.5 + 0.5 * mean)[hidden], atol=1e-5, rtol=0)


@pytest.mark.parametrize("value", [-1.0, 1.0])
def test_extreme_answers_and_bodies_stay_finite(value: float) -> None:
    mean = torch.full((1, 1, SIZE, SIZE), value)
    person = disc(32.0)
    for body in (person, torch.ones_like(person), disc(60.0, 60.0, 2.0)):
        out = fitted()(mean, crop(person, body, right_half()))
        assert torch.isfinite(out).all() and out.min() >= 0.0 and out.max() <= 1.0


def test_each_crop_of_a_batch_is_fused_by_itself() -> None:
    fusion, rows = fitted(), people(3, 5)
    batch = Conditions(*(torch.cat([getattr(row[1], name) for row in rows]) for name in vars(rows[0][1])))
    together = fusion(torch.cat([row[0] for row in rows]), batch)
    for k, (mean, conditions, _, _) in enumerate(rows):
        torch.testing.assert_close(together[k : k + 1], fusion(mean, conditions))


def test_weights_of_a_network_without_fusion_load_as_the_identity() -> None:
    net = SilhouetteNet((8, 8, 8), 1)
    state = {name: value for name, value in net.state_dict().items() if not name.startswith("fusion")}
    net.fusion.weights.fill_(3.0)
    net.load_state_dict(state)
    assert torch.equal(net.fusion.weights, identity())


def test_logistic_regression_agrees_with_a_general_minimiser() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(400, 3)) * [1.0, 5.0, 0.1]
    y = rng.uniform(size=400) < sigmoid(x @ np.array([1.0, -0.4, 3.0]))
    start, strength = np.array([1.0, 0.0, 0.0]), 2.0
    w = torch.tensor(start, requires_grad=True)
    minimiser = torch.optim.LBFGS([w], max_iter=500, tolerance_grad=1e-12, tolerance_change=1e-14)

    def loss() -> Tensor:
        minimiser.zero_grad()
        logits, target = torch.tensor(x) @ w, torch.tensor(y, dtype=torch.float64)
        value = torch.nn.functional.binary_cross_entropy_with_logits(logits, target, reduction="sum")
        value = value + 0.5 * strength * (w - torch.tensor(start)).square().sum()
        value.backward()  # type: ignore[no-untyped-call]
        return value

    minimiser.step(loss)  # type: ignore[arg-type]
    np.testing.assert_allclose(fit_logistic(x, y, start, strength), w.detach().numpy(), atol=1e-5)


def test_separable_labels_give_finite_weights() -> None:
    x = np.stack([np.linspace(-50.0, 50.0, 100), np.ones(100)], axis=1)
    weights = fit_logistic(x, x[:, 0] > 0, np.zeros(2), 1.0)
    assert np.isfinite(weights).all()
    assert ((x @ weights > 0) == (x[:, 0] > 0)).all()
