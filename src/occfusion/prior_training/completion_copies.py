"""How much of what is in front alone the completion of colours puts on the back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from occfusion.geometry.normals import vertex_normals
from occfusion.inpaint.accumulation import Accumulated
from occfusion.prior_training.completion_examples import watched
from occfusion.prior_training.completion_people import UNCHANGED, VALIDATION, vertex_colours
from occfusion.synth.fullbody import load_model_body
from occfusion.synth.rotations import Floats
from occfusion.synth.subject import make_subject

MARKS = {"print": replace(UNCHANGED, marked=1.0), "hair": replace(UNCHANGED, no_top=1.0, hairy=1.0)}
"""People who have them all: in a plain top, and without one."""
SIDE, LOW, HIGH = 0.17, 0.06, 0.45
"""Metres from the middle, and heights on the template, of the trunk's front and back."""
FACING = 0.3
"""Cosine of a normal and the direction to the front, or the back, from which on a place belongs to it."""
LEAST_CONTRAST = 1.0
"""Squared and summed over the back's vertices: a mark of less contrast hardly shows."""


@dataclass(frozen=True)
class MarkedExample:
    """A person with marks in front alone, seen from there.

    Attributes:
        truth: colours of the person, `[V, 3]`, 0..1.
        plain: of the same person without the marks, `[V, 3]`.
        shown: what a short video shows.
    """

    truth: Floats
    plain: Floats
    shown: Accumulated


@cache
def _opposite() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the vertices of the back, and of the front the one right before each."""
    model = load_model_body()
    places, normals = model.template, vertex_normals(model.template, model.faces)
    is_trunk = (np.abs(places[:, 0]) < SIDE) & (places[:, 1] > LOW) & (places[:, 1] < HIGH)
    front, back = (np.flatnonzero(is_trunk & (sign * normals[:, 2] > FACING)) for sign in (1.0, -1.0))
    return back, front[KDTree(places[front, :2]).query(places[back, :2])[1]]


def marked_examples(marks: str, count: int, seed: int = 0) -> Iterator[MarkedExample]:
    """Yields people whom the network has not learned from, always the same; those whose marks hardly show are left out.

    Args:
        marks: `print` or `hair`.
        count: of people, left out ones among them.
        seed: of all choices.
    """
    looks, (_, front) = MARKS[marks], _opposite()
    for number in range(count):
        subject = replace(make_subject(VALIDATION[number % len(VALIDATION)]), pattern="plain")
        truth, plain = (
            vertex_colours(subject, np.random.default_rng([seed, number]), each)
            for each in (looks, replace(looks, marked=0.0, hairy=0.0))
        )
        if np.square((truth - plain)[front]).sum() >= LEAST_CONTRAST:
            shown = watched(truth, subject.betas, np.random.default_rng([seed, number, 1]), facing=0.0)
            yield MarkedExample(truth, plain, shown)


def copied_share(found: Iterable[Floats], examples: Iterable[MarkedExample]) -> float:
    """Returns which share of the contrast of marks lies on the back right behind them: 0 none of it, 1 all.

    The least squares factor between the two, over all people, after what a brightness of the whole back in each channel
    explains of either: a lamp that was not quite found darkens a back as dark marks would.

    Args:
        found: colours of each person, `[V, 3]`, 0..1.
        examples: the people, at least one.
    """
    back, front = _opposite()
    products = contrasts = 0.0
    for colours, example in zip(found, examples, strict=True):
        plain = example.plain[back]
        contrast = _without(plain, (example.truth - example.plain)[front])
        products += float((contrast * _without(plain, colours[back] - plain)).sum())
        contrasts += float(np.square(contrast).sum())
    return products / contrasts


def _without(plain: Floats, values: Floats) -> Floats:
    """Returns values less their part that is proportional to `plain`, channel by channel, `[N, 3]`."""
    return values - (plain * values).sum(axis=0) / np.square(plain).sum(axis=0) * plain


def back_psnr(found: Iterable[Floats], examples: Iterable[MarkedExample]) -> float:
    """Returns the PSNR of the backs, dB; arguments as those of `copied_share`."""
    back, _ = _opposite()
    errors = [
        np.square(colours - example.truth)[back].mean()
        for colours, example in zip(found, examples, strict=True)
    ]
    return float(-10.0 * np.log10(np.mean(errors)))
