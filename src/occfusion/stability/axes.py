"""What is swept, what is measured there, and what its errors may be."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

Answer = tuple[Mapping[str, Tensor], Mapping[str, Tensor]]
"""Values and gradients, by name."""
TYPES = {"float32": torch.float32, "float64": torch.float64, "bfloat16": torch.bfloat16}
ROUNDS = 3


@dataclass(frozen=True)
class Bound:
    """What relative errors in the 2-norm may be.

    Attributes:
        value: of what is computed.
        gradient: of its gradients.
    """

    value: float
    gradient: float


@dataclass(frozen=True)
class Method:
    """One way to compute something.

    Attributes:
        name: as in tables, the precision with it.
        answer: gives values and gradients at a place of the axis.
        bound: of its errors.
    """

    name: str
    answer: Callable[[float], Answer]
    bound: Bound


@dataclass(frozen=True)
class Axis:
    """An axis along which a problem becomes stiff.

    Attributes:
        name: of the axis, with its unit.
        places: where it is looked at.
        quick: those of `--quick`.
        methods: what is looked at.
        oracle: what is right, in float64, by other code.
    """

    name: str
    places: Sequence[float]
    quick: Sequence[float]
    methods: Sequence[Method]
    oracle: Callable[[float], Answer]


@dataclass(frozen=True)
class Row:
    """One case.

    Attributes:
        axis: name of the axis.
        place: on it.
        method: name of the method.
        error: of the value, relative.
        gradient_error: of the worst gradient, relative.
        bound: of the value's error.
        gradient_bound: of the gradients'.
        milliseconds: of one call, the least of a few.
        verdict: `holds`, `exceeds`, or what it raised.
    """

    axis: str
    place: float
    method: str
    error: float | None
    gradient_error: float | None
    bound: float
    gradient_bound: float
    milliseconds: float | None
    verdict: str


def sweep(axis: Axis, *, quick: bool) -> list[Row]:
    """Returns the cases of an axis, place by place."""
    rows = []
    for place in axis.quick if quick else axis.places:
        wanted = axis.oracle(place)
        rows += [_case(axis, place, method, wanted, 1 if quick else ROUNDS) for method in axis.methods]
    return rows


def _case(axis: Axis, place: float, method: Method, wanted: Answer, rounds: int) -> Row:
    bound, least = method.bound, float("inf")
    try:
        for _ in range(rounds):
            started = time.perf_counter()
            found = method.answer(place)
            least = min(least, 1e3 * (time.perf_counter() - started))
    except Exception as error:  # a sweep goes on, and its table says what happened
        said = f"{type(error).__name__}: {str(error).splitlines()[0]}" if str(error) else type(error).__name__
        return Row(axis.name, place, method.name, None, None, bound.value, bound.gradient, None, said)
    value, gradient = (_worst(ours, theirs) for ours, theirs in zip(found, wanted, strict=True))
    holds = value <= bound.value and gradient <= bound.gradient  # not a number is in no bound
    verdict = "holds" if holds else "exceeds"
    return Row(axis.name, place, method.name, value, gradient, bound.value, bound.gradient, least, verdict)


def _worst(found: Mapping[str, Tensor], wanted: Mapping[str, Tensor]) -> float:
    # numpy's maximum is not a number where one of them is not, which Python's may pass over
    return float(np.max([_relative(found[name], value) for name, value in wanted.items()], initial=0.0))


def _relative(found: Tensor, wanted: Tensor) -> float:
    """Returns the error in the 2-norm, relative to what is wanted or to 1e-6, whichever is larger."""
    difference = (found.detach().double().cpu() - wanted.detach().double()).norm()
    return float(difference / wanted.detach().double().norm().clamp_min(1e-6))
