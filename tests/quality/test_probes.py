"""Probes give each moment to one part: nothing twice, nothing lost, backward passes to the part that made them."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest
import torch

from occfusion.bench.probes import BACKWARD, FORWARD, Probes


def busy(seconds: float) -> None:
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


class Slow(torch.autograd.Function):
    @staticmethod
    def forward(ctx, value, seconds):
        ctx.seconds = seconds
        return value * 1.0

    @staticmethod
    def backward(ctx, gradient):
        busy(ctx.seconds)
        return gradient, None


def made() -> tuple[SimpleNamespace, torch.Tensor]:
    leaf = torch.ones(3, requires_grad=True)
    thing = SimpleNamespace()

    def inner(value):
        busy(0.03)
        return Slow.apply(value, 0.05)

    def outer(value):
        busy(0.02)
        return Slow.apply(thing.inner(value), 0.08)

    thing.inner, thing.outer = inner, outer
    thing.backward = lambda loss: loss.backward()
    return thing, leaf


def test_each_part_has_its_own_time_alone_and_all_of_it_adds_up() -> None:
    thing, leaf = made()
    originals = dict(vars(thing))
    probes = Probes("rest")
    for name in ("inner", "outer"):
        probes.around(thing, name, name)
    probes.around_backward(thing, "backward")
    began = time.process_time()
    probes.start()
    busy(0.04)
    thing.backward(thing.outer(leaf).sum())
    probes.stop()
    whole = time.process_time() - began
    spent = {key: part.cpu for key, part in probes.totals().items()}
    wanted = {
        ("rest", FORWARD): 0.04, ("outer", FORWARD): 0.02, ("inner", FORWARD): 0.03,
        ("outer", BACKWARD): 0.08, ("inner", BACKWARD): 0.05,
    }  # fmt: skip
    for key, seconds in wanted.items():
        assert spent[key] == pytest.approx(seconds, abs=0.012), key
    assert sum(spent.values()) == pytest.approx(whole, rel=0.05)
    assert leaf.grad is not None and leaf.grad.tolist() == [1.0, 1.0, 1.0]
    probes.remove()
    assert dict(vars(thing)) == originals


def test_nothing_is_counted_while_probes_are_off() -> None:
    thing, leaf = made()
    probes = Probes("rest")
    probes.around(thing, "outer", "outer")
    probes.around_backward(thing, "backward")
    thing.backward(thing.outer(leaf).sum())
    assert probes.totals() == {}


def test_an_optimisers_closure_is_not_its_own_time() -> None:
    value = torch.ones(2, requires_grad=True)
    adam = torch.optim.Adam([value])
    probes = Probes("rest")
    probes.around_closure(adam, "step", "Adam")
    probes.start()

    def closure():
        busy(0.05)
        loss = value.sum()
        loss.backward()
        return loss

    adam.step(closure)
    probes.stop()
    spent = {name: part.cpu for (name, _), part in probes.totals().items()}
    assert spent["rest"] >= 0.05 and spent["Adam"] < 0.045
    probes.remove()
    assert "step" not in vars(adam)
