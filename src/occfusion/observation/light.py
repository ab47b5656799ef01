"""What a video tells of light: a lamp, and how the camera's exposure wanders; each is found with the other known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from occfusion.observation.exposure import Exposure, fit_gains, gain_of, judge
from occfusion.observation.frames import ObservedFrame
from occfusion.observation.key_light import KeyLight, fit_key_light
from occfusion.observation.sightings import Floats, Sightings, join, sight_frames, without
from occfusion.types import Frame

FRAMES = 50
"""Frames that are looked at, evenly spread; more say the same."""
ENOUGH = 15_000
"""Sightings: exposure, and what a lamp is judged by, are told by so many as well as by more."""
ROUNDS = 2
"""Of lamp and exposure in turn, where exposure wanders."""


@dataclass(frozen=True)
class Light:
    """What was found.

    Attributes:
        key_light: the lamp; None where too little is seen to tell.
        disagreement: how far the lamps lie apart that two halves of the body tell, of their mean's length; infinite
            where one of them tells none.
        exposure: None where too little is seen to tell, or nobody asked.
        gains: what the colours of each training frame are divided by, `[N, 3]`; None where they stay as they are.
    """

    key_light: KeyLight | None = None
    disagreement: float = float("inf")
    exposure: Exposure | None = None
    gains: Floats | None = None


def observe_light(
    read: Callable[[int], Frame],
    observed_frames: Sequence[ObservedFrame],
    faces: NDArray[np.integer],
    *,
    even: bool,
) -> Light:
    """Returns what a video tells of light.

    Args:
        read: gives the training frame at a position, without truth.
        observed_frames: what is known of each.
        faces: of the body mesh, `[F, 3]`.
        even: whether exposure is asked for.
    """
    count = len(observed_frames)
    looked = np.unique(np.linspace(0, count - 1, min(FRAMES, count)).round().astype(int)).tolist()
    light = fit_light(join(sight_frames(looked, read, observed_frames, faces)), even=even)
    exposure = light.exposure
    if exposure is None or not exposure.is_taken:
        return light
    measured, logs = exposure.gains, np.zeros((count, 3))
    logs[measured.positions] = measured.logs
    known = set(measured.positions.tolist())
    for position in range(count):
        if position not in known:
            [own] = sight_frames([position], read, observed_frames, faces)
            logs[position] = gain_of(own, measured)
    return replace(light, gains=exposure.evened(logs - logs.mean(axis=0)))


def fit_light(seen: Sightings, *, even: bool) -> Light:
    """Returns lamp and exposure of sightings; nothing follows from the exposure yet.

    Args:
        seen: the sightings.
        even: whether exposure is asked for.
    """
    few, exposure = seen.thinned(ENOUGH), None
    begun = fit_key_light(few)
    lamp = None if begun is None else fit_key_light(seen, begun.vector)
    evened = few
    for _ in range(ROUNDS if even else 0):
        gains = fit_gains(few, _vector(lamp))
        if gains is None:
            break
        found = judge(few, gains)
        if exposure is None or found.is_taken:
            exposure = found
        if not found.is_taken:
            break
        evened = without(few, exposure.gains_at(few.frames))
        lamp = fit_key_light(evened)
    if lamp is None:
        return Light(exposure=exposure)
    return Light(lamp, disagreement([fit_key_light(half) for half in evened.halves()]), exposure)


def disagreement(lamps: Sequence[KeyLight | None]) -> float:
    """Returns how far two lamps lie apart, of their mean's length; infinite where one is missing."""
    if any(lamp is None for lamp in lamps):
        return float("inf")
    one, other = (_vector(lamp) for lamp in lamps)
    return 2.0 * float(np.linalg.norm(one - other)) / max(float(np.linalg.norm(one + other)), 1e-12)


def _vector(lamp: KeyLight | None) -> Floats:
    return np.zeros(3) if lamp is None else lamp.vector
