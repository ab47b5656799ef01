"""How a camera's exposure and white balance wander, told by the colours of body points from frame to frame.

All points of a frame are as much too bright, in each of the three channels: that is exposure, and no light that a
surface turns to or from. Each point's own colour drops out, as it does for the lamp (`key_light`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix, diags_array

from occfusion.observation.sightings import CUT, Floats, Integers, Sightings, brightness, robust_weights, sums

WORTH = 0.2
"""Of the differences between sightings of a point under a lamp: gains that explain less are left out, for so much may
be a lamp that is not quite as it is modelled, or poses."""
EVEN_ROUNDS, ROUNDS, SHORT = 4, 20, 1e-3
"""Rounds in which all observations count alike, and in all: a frame that is far off must not be left out at once."""
RIDGE = 1e-3
"""Of a frame's mean weight: holds the gain of a frame that shows hardly a point."""
LEAST = 1.0 / 255.0
"""Difference that is never too much."""
CLIPPED = 0.98
"""What is brighter may have been brighter still, and tells nothing."""


@dataclass(frozen=True)
class Gains:
    """How much brighter frames are than they are on average.

    Attributes:
        positions: of the frames, ascending, `[F]`.
        logs: natural logarithms, a column a channel, `[F, 3]`; means are 0.
        points: vertex numbers, ascending, `[P]`.
        colors: own colour of each under the mean exposure and even light, `[P, 3]`.
        usual: median difference of a sighting that is left, 0..1; `LEAST` at least.
        vector: of the lamp that they were found under, as `KeyLight` has it; 0: none.
    """

    positions: Integers
    logs: Floats
    points: Integers
    colors: Floats
    usual: float
    vector: Floats


@dataclass(frozen=True)
class Exposure:
    """How exposure wanders in a video, as far as two halves of the body agree on it.

    Attributes:
        gains: as measured.
        trust: in them, a channel each, 0..1: the share of their variance that is no noise.
        spread: standard deviation of what is trusted, of the natural logarithm, root mean square of the channels.
        explained: share of the differences between sightings of a point under the lamp that the gains explain.
    """

    gains: Gains
    trust: Floats
    spread: float
    explained: float

    @property
    def is_taken(self) -> bool:
        """Whether pictures are evened."""
        return self.explained >= WORTH

    def evened(self, logs: Floats) -> Floats:
        """Returns the gains that pictures are divided by, of logarithms as measured."""
        return np.asarray(np.exp(self.trust * logs))

    def gains_at(self, frames: Integers) -> Floats:
        """Returns the same of frames that were measured, by their positions `[M]`, `[M, 3]`."""
        return self.evened(self.gains.logs[np.searchsorted(self.gains.positions, frames)])

    def text(self) -> str:
        """Returns what was found, in words."""
        return (
            f"exposures that spread by {self.spread:.1%} explain {self.explained:.0%} of how points of the body differ "
            f"from frame to frame; {WORTH:.0%} would be evened"
        )


def fit_gains(seen: Sightings, vector: Floats) -> Gains | None:
    """Returns the gains of frames under a lamp that make each point's colour vary least; None where nothing tells.

    Gauss-Newton with Geman and McClure's weights, points' own colours eliminated.

    Args:
        seen: the sightings.
        vector: of the lamp, as `KeyLight` has it; 0: none.
    """
    numbered = seen.numbered()
    if numbered is None:
        return None
    points, count = numbered
    positions, frames = np.unique(seen.frames, return_inverse=True)
    light = brightness(seen.normals, vector)[:, None]
    tells = (seen.colors < CLIPPED).astype(np.float64)
    logs, weights = np.zeros((len(positions), 3)), np.ones(len(points))
    for round_ in range(ROUNDS):
        bright = light * np.exp(logs)[frames]
        told = weights[:, None] * tells
        norm = np.maximum(sums(points, told * bright**2, count), 1e-12)
        own = sums(points, told * bright * seen.colors, count) / norm
        residual = tells * (seen.colors - own[points] * bright)
        differences = np.linalg.norm(residual, axis=1)
        usual = max(float(np.median(differences)), LEAST)
        if round_ >= EVEN_ROUNDS:
            weights = robust_weights(differences, CUT * usual)
            told = weights[:, None] * tells
        steps = [
            _step(points, frames, bright[:, c], own[:, c], residual[:, c], told[:, c], logs[:, c])
            for c in range(3)
        ]
        logs = logs + np.stack(steps, axis=1)
        logs = logs - logs.mean(axis=0)
        if round_ > EVEN_ROUNDS and np.abs(steps).max() < SHORT:
            break
    return Gains(positions, logs, np.unique(seen.points), own, usual, vector)


def gain_of(seen: Sightings, gains: Gains) -> Floats:
    """Returns the logarithms of another frame's gain, by points whose colours are known, `[3]`; 0 where it shows none.

    Args:
        seen: of that frame.
        gains: of others.
    """
    known = np.isin(seen.points, gains.points)
    own = gains.colors[np.searchsorted(gains.points, seen.points[known])]
    expected = own * brightness(seen.normals[known], gains.vector)[:, None]
    colors, log = seen.colors[known], np.zeros(3)
    tells = (colors < CLIPPED).astype(np.float64)
    for _ in range(ROUNDS):
        predicted = expected * np.exp(log)
        residual = tells * (colors - predicted)
        differences = np.linalg.norm(residual, axis=1)
        weights = tells * robust_weights(differences, CUT * gains.usual)[:, None]
        curvature = (weights * predicted**2).sum(axis=0)
        ridge = RIDGE * float(len(colors)) * float((gains.colors**2).mean()) + 1e-12
        step = ((weights * predicted * residual).sum(axis=0) - ridge * log) / (curvature + ridge)
        log = log + step
        if np.abs(step).max() < SHORT:
            break
    return log


def judge(seen: Sightings, gains: Gains) -> Exposure:
    """Returns how far gains are trusted: by what two halves of the body agree on.

    Args:
        seen: the sightings that they were found by.
        gains: of these.
    """
    one, other = (fit_gains(half, gains.vector) for half in seen.halves())
    if one is None or other is None:
        return Exposure(gains, np.zeros(3), 0.0, 0.0)
    both = np.intersect1d(one.positions, other.positions)
    a, b = (half.logs[np.searchsorted(half.positions, both)] for half in (one, other))
    if len(both) < 2:
        return Exposure(gains, np.zeros(3), 0.0, 0.0)
    shared = np.maximum(((a - a.mean(axis=0)) * (b - b.mean(axis=0))).mean(axis=0), 0.0)
    noise = (a - b).var(axis=0) / 4.0  # of their mean
    trust = shared / np.maximum(shared + noise, 1e-12)
    judged = Exposure(gains, trust, float(np.sqrt(shared.mean())), 0.0)
    light = brightness(seen.normals, gains.vector)[:, None]
    before, after = (_usual(seen, light * how) for how in (np.ones(3), judged.gains_at(seen.frames)))
    return replace(judged, explained=1.0 - after / before)


def _usual(seen: Sightings, bright: Floats) -> float:
    """Returns the median difference of a sighting from its point's own colour; `LEAST` at least.

    Args:
        seen: the sightings.
        bright: how bright each is, a channel, `[M, 3]`.
    """
    points = np.unique(seen.points, return_inverse=True)[1]
    count, weights, usual = int(points.max()) + 1, np.ones(len(points)), LEAST
    for _ in range(2 * EVEN_ROUNDS):
        told = weights[:, None] * np.broadcast_to(bright, seen.colors.shape)
        own = sums(points, told * seen.colors, count) / np.maximum(sums(points, told * bright, count), 1e-12)
        differences = np.linalg.norm(seen.colors - own[points] * bright, axis=1)
        usual = max(float(np.median(differences)), LEAST)
        weights = robust_weights(differences, CUT * usual)
    return usual


def _step(
    points: Integers,
    frames: Integers,
    bright: Floats,
    own: Floats,
    residual: Floats,
    weights: Floats,
    logs: Floats,
) -> Floats:
    """Returns Gauss-Newton's step of one channel's logarithms, `[F]`; `own` is a point's, the rest a sighting's."""
    change, size, count = own[points] * bright, len(logs), len(own)
    curvature = np.bincount(frames, weights * change**2, size)
    shared = csr_matrix((weights * change * bright, (points, frames)), shape=(count, size))
    inverse = diags_array(1.0 / np.maximum(np.bincount(points, weights * bright**2, count), 1e-12))
    ridge = RIDGE * float(curvature.mean()) + 1e-12
    hessian = np.diag(curvature + ridge) - (shared.T @ inverse @ shared).toarray()
    gradient = np.bincount(frames, weights * change * residual, size) - ridge * logs
    return np.asarray(np.linalg.solve(hessian, gradient))
