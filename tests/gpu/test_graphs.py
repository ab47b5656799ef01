"""Recorded functions give what the functions give; on a CPU they are the functions.

CUDA_VISIBLE_DEVICES=0 python -m pytest tests/gpu
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor, nn

from occfusion.gpu import graphs
from occfusion.gpu.graphs import CALLS_BEFORE, MOST_KEPT, GraphedFunction
from occfusion.gpu.sums import total

on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device is named")
RECORDED = CALLS_BEFORE + 2


@pytest.fixture(autouse=True)
def recording() -> Iterator[None]:
    graphs.record(True)
    yield
    graphs.record(False)


class Counted:
    """A function of a parameter and two inputs, with a second result that has no gradient; counts its calls."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, weight: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        self.calls += 1
        return (weight * a).sin() @ b, (a > 0.5).int()


def inputs(seed: int, rows: int = 5) -> tuple[nn.Parameter, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    weight, a, b = (torch.rand(rows, rows, generator=generator).cuda() for _ in range(3))
    return nn.Parameter(weight), a.requires_grad_(), b


def assert_as_the_function(graphed: GraphedFunction, weight: nn.Parameter, a: Tensor, b: Tensor) -> None:
    found, wanted = graphed(weight, a, b), Counted()(weight, a, b)
    torch.testing.assert_close(found[0], wanted[0], rtol=0, atol=0)
    assert torch.equal(found[1], wanted[1]) and not found[1].requires_grad
    gradients = [torch.autograd.grad(result[0].square().sum(), (weight, a)) for result in (found, wanted)]
    for ours, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-6)


def test_on_a_cpu_the_function_is_called() -> None:
    function = Counted()
    graphed = GraphedFunction(function)
    a = torch.rand(3, 3)
    for _ in range(RECORDED):
        assert torch.equal(graphed(a, a, a)[0], Counted()(a, a, a)[0])
    assert function.calls == RECORDED and not graphed._recordings


@on_gpu
def test_results_and_gradients_of_the_function() -> None:
    """Also of inputs that were never seen, and of a parameter that an optimiser has changed in place."""
    function = Counted()
    graphed = GraphedFunction(function)
    weight = inputs(0)[0]
    for seed in range(10):
        assert_as_the_function(graphed, weight, *inputs(seed)[1:])
        with torch.no_grad():
            weight.mul_(0.9)
    checked = 2 * graphs.CHECKED_FIRST  # forwards and backwards
    assert function.calls == CALLS_BEFORE + graphs.WARM_UPS + 1 + checked and len(graphed._recordings) == 1


@on_gpu
def test_gradients_of_two_calls_do_not_mix() -> None:
    graphed = GraphedFunction(Counted())
    weight = inputs(0)[0]
    for _ in range(RECORDED):
        assert_as_the_function(graphed, weight, *inputs(1)[1:])
    (a, b), (c, d) = inputs(2)[1:], inputs(3)[1:]
    first, second = graphed(weight, a, b), graphed(weight, c, d)
    wanted = Counted()(weight, a, b)
    torch.testing.assert_close(first[0], wanted[0], rtol=0, atol=0)
    torch.testing.assert_close(second[0], Counted()(weight, c, d)[0], rtol=0, atol=0)
    for ours, theirs in ((first, wanted),):
        found = [torch.autograd.grad(result[0].sum(), (weight, a))[0] for result in (ours, theirs)]
        torch.testing.assert_close(*found, rtol=1e-6, atol=1e-6)
    del first, second, found
    assert_as_the_function(graphed, weight, *inputs(4)[1:])
    assert not next(iter(graphed._recordings.values())).is_busy


@on_gpu
def test_a_call_whose_gradient_is_never_asked_for_blocks_no_other() -> None:
    function = Counted()
    graphed = GraphedFunction(function)
    weight, a, b = inputs(0)
    for _ in range(3 * RECORDED):
        graphed(weight, a, b)
    assert function.calls == CALLS_BEFORE + graphs.WARM_UPS + 1 + graphs.CHECKED_FIRST


@on_gpu
def test_without_gradients_and_in_inference_mode() -> None:
    graphed = GraphedFunction(Counted())
    weight, a, b = inputs(0)
    for _ in range(RECORDED):
        with torch.no_grad():
            found = graphed(weight, a, b)
        assert not found[0].requires_grad
        torch.testing.assert_close(found[0], Counted()(weight, a, b)[0], rtol=0, atol=0)
    with torch.inference_mode():
        assert graphed(weight, a, b)[0].is_inference()
    assert_as_the_function(graphed, weight, a, b)


@on_gpu
def test_what_cannot_be_recorded_is_called(caplog: pytest.LogCaptureFixture) -> None:
    def asks(a: Tensor) -> tuple[Tensor]:
        return (a * float(a.sum()),)

    graphed = GraphedFunction(asks)
    a = torch.rand(4).cuda()
    with caplog.at_level(logging.WARNING):
        for _ in range(2 * RECORDED):
            torch.testing.assert_close(graphed(a)[0], a * a.sum())
    assert len(caplog.records) == 1 and "asks" in caplog.text
    assert_as_the_function(GraphedFunction(Counted()), *inputs(0))


@on_gpu
def test_few_recordings_are_kept() -> None:
    graphed = GraphedFunction(Counted())
    for rows in range(2, 2 + 2 * MOST_KEPT):
        for _ in range(RECORDED):
            assert_as_the_function(graphed, *inputs(rows, rows))
    assert len(graphed._recordings) <= MOST_KEPT


class Graph:
    def __init__(self, replay: Callable[[], None]) -> None:
        self.replay = replay


class HostRecording(graphs._Recording):
    """A recording without a GPU: its graphs are calls of the function that write where results lie."""

    off = 0.0

    def __init__(self, function: graphs.Function, inputs: tuple[Tensor, ...]) -> None:
        self._function, self._count, self.is_wrong, self._call = function, 0, False, None
        own = (t.detach() if isinstance(t, nn.Parameter) else t.detach().clone() for t in inputs)
        self._inputs = [t.requires_grad_(given.requires_grad) for t, given in zip(own, inputs, strict=True)]
        outputs = function(*self._inputs)
        self._has_gradient = [output.requires_grad for output in outputs]
        self._given = [torch.zeros_like(output) for output in outputs]
        self._gradients = graphs._gradients(outputs, self._inputs, self._given)
        self._outputs = [output.detach().clone() for output in outputs]
        self._pending: tuple[Tensor, ...] = ()
        self._forward, self._backward = Graph(self._run), Graph(self._run_backwards)  # type: ignore[assignment]

    @torch.enable_grad()
    def _run(self) -> None:
        self._pending = self._function(*self._inputs)
        for own, result in zip(self._outputs, self._pending, strict=True):
            own.copy_(result.detach())

    def _run_backwards(self) -> None:
        found = graphs._gradients(self._pending, self._inputs, self._given)
        for own, gradient in zip(self._gradients, found, strict=True):
            if own is not None and gradient is not None:
                own.copy_(gradient * (1.0 + self.off))


@pytest.fixture
def on_host(monkeypatch: pytest.MonkeyPatch) -> None:
    HostRecording.off = 0.0
    monkeypatch.setattr(graphs, "_Recording", HostRecording)
    monkeypatch.setattr(graphs, "_may_be_recorded", lambda inputs: True)


@pytest.mark.usefixtures("on_host")
def test_a_recording_that_goes_wrong_is_found_and_not_used(caplog: pytest.LogCaptureFixture) -> None:
    """At the next look at it the function's own gradients are given, and from then on the function is called."""
    graphed = GraphedFunction(Counted())
    weight, a, b = (nn.Parameter(torch.rand(4, 4)), torch.rand(4, 4).requires_grad_(), torch.rand(4, 4))
    wanted = torch.autograd.grad(Counted()(weight, a, b)[0].sum(), (weight, a))

    def gradients() -> tuple[Tensor, ...]:
        return torch.autograd.grad(graphed(weight, a, b)[0].sum(), (weight, a))

    for _ in range(CALLS_BEFORE + graphs.CHECKED_FIRST + 2):
        for ours, theirs in zip(gradients(), wanted, strict=True):
            torch.testing.assert_close(ours, theirs)
    HostRecording.off = 0.1
    wrong = 0
    with caplog.at_level(logging.WARNING):
        for _ in range(2 * graphs.CHECKED_EVERY):
            wrong += not torch.allclose(gradients()[0], wanted[0])
    assert 0 < wrong < graphs.CHECKED_EVERY
    assert graphed._is_refused and not graphed._recordings
    assert len(caplog.records) == 1 and "something else" in caplog.text


@pytest.mark.usefixtures("on_host")
@pytest.mark.parametrize("off", [2 * graphs.ROUNDING, float("nan")])
def test_wrong_from_the_first_call_on_is_never_given(off: float) -> None:
    HostRecording.off = off
    graphed = GraphedFunction(Counted())
    weight, a, b = (nn.Parameter(torch.rand(4, 4)), torch.rand(4, 4), torch.rand(4, 4))
    (wanted,) = torch.autograd.grad(Counted()(weight, a, b)[0].sum(), weight)
    for _ in range(4 * RECORDED):
        (found,) = torch.autograd.grad(graphed(weight, a, b)[0].sum(), weight)
        torch.testing.assert_close(found, wanted)
    assert graphed._is_refused


@pytest.mark.usefixtures("on_host")
def test_without_a_gpu_by_the_same_rules() -> None:
    """Two calls do not mix, parameters are read where they are, other shapes are other recordings."""
    function = Counted()
    graphed = GraphedFunction(function)
    weight = nn.Parameter(torch.rand(3, 3))
    a, b, c = torch.rand(3, 3), torch.rand(3, 3), torch.rand(3, 3)
    for _ in range(RECORDED):
        torch.autograd.grad(graphed(weight, a, b)[0].sum(), weight)
    first, second = graphed(weight, a, b)[0], graphed(weight, c, b)[0]
    torch.testing.assert_close(first, Counted()(weight, a, b)[0])
    torch.testing.assert_close(second, Counted()(weight, c, b)[0])
    del first, second
    with torch.no_grad():
        weight.mul_(0.5)
    torch.testing.assert_close(graphed(weight, c, b)[0], Counted()(weight, c, b)[0])
    other = torch.rand(2, 2)
    assert torch.equal(graphed(other, other, other)[0], Counted()(other, other, other)[0])
    assert len(graphed._recordings) == 1
    graphs.record(False)
    assert not graphed._recordings
    for _ in range(RECORDED):
        graphed(weight, a, b)
    assert not graphed._recordings


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=on_gpu)])
def test_sums(device: str) -> None:
    parts = [torch.arange(6.0).view(2, 3), torch.tensor(4.0), torch.zeros(0, 3)]
    assert float(total(part.to(device) for part in parts)) == 19.0
    parts[1] = torch.tensor(float("nan"))
    assert not bool(total(part.to(device) for part in parts).isfinite())
