"""Where the light comes from, told by how the colours of body points change as they turn.

A point of the body is seen in many frames, facing other ways. What changes with the direction it faces, for all points
alike, is light: even light from all around and one far lamp, by Lambert's law. Each point's own colour drops out
(variable projection: Golub and Pereyra 1973). From one camera a general light (harmonics over normals) is not
determined along the line of sight; a lamp's is, by where its light ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.observation.sightings import CUT, Floats, Sightings, brightness, robust_weights, sums

STEPS, EVEN_STEPS = 40, 5
"""Rounds of weighing, at most, with a lamp to find and without."""
DAMPING, SHORT = 1e-3, 1e-4
LONGEST_STEP = 0.2
STRONGEST = 5.0
"""Times the even light; a lamp that is stronger is not told from any other, all else being dark."""


@dataclass(frozen=True)
class KeyLight:
    """An estimated lamp.

    Attributes:
        vector: towards the lamp, as long as it is strong beside the even light, `[3]`.
        before: how far a point's colour lies from its own mean under even light, median over sightings, 0..1.
        after: the same with the lamp.
        condition: of the lamp's three numbers: the largest over the smallest curvature of the error.
    """

    vector: Floats
    before: float
    after: float
    condition: float

    @property
    def explained(self) -> float:
        """Share of the differences that the lamp explains, 0..1."""
        return 1.0 - self.after / self.before if self.before > 0.0 else 0.0


def fit_key_light(seen: Sightings, near: Floats | None = None) -> KeyLight | None:
    """Returns the lamp that makes each point's colour, divided by its brightness, vary least; None where nothing tells.

    Gauss-Newton with Geman and McClure's weights; of several ends the best is taken.

    Args:
        seen: the sightings.
        near: lamp to begin at, `[3]`; None: from six sides.
    """
    numbered = seen.numbered()
    if numbered is None:
        return None
    fit, dark = _Fit(*numbered, seen.colors, seen.normals), np.zeros(3)
    usual = float(np.median(fit.differences(dark)))
    if usual <= 0.0:
        return None
    fit.scale = CUT * usual
    for _ in range(EVEN_STEPS):
        fit.weigh(dark)
    before, cost_before = float(np.median(fit.differences(dark))), fit.cost(dark)
    starts = LONGEST_STEP * np.vstack([np.eye(3), -np.eye(3)]) if near is None else near[None]
    ends = [end for start in starts if (end := fit.descend(start))]
    if not ends:
        return None
    vector, cost, condition = min(ends, key=lambda end: end[1])
    if cost >= cost_before:
        return None
    for _ in range(EVEN_STEPS):
        fit.weigh(vector)
    return KeyLight(vector, before, float(np.median(fit.differences(vector))), condition)


class _Fit:
    """The error of a lamp, each point's own colour being the best for it."""

    def __init__(self, points: NDArray[np.int64], count: int, colors: Floats, normals: Floats) -> None:
        self.points, self.count, self.colors, self.normals = points, count, colors, normals
        self.scale = np.inf
        self._weights = np.ones(len(points))

    def differences(self, vector: Floats) -> Floats:
        """Returns how far each sighting lies from its point's colour under the lamp, `[M]`."""
        return np.asarray(np.linalg.norm(self._residual(vector, self._weights)[0], axis=1))

    def cost(self, vector: Floats) -> float:
        """Returns Geman and McClure's error of a lamp."""
        squared = (self.differences(vector) / self.scale) ** 2
        return float((squared / (1.0 + squared)).mean())

    def weigh(self, vector: Floats) -> None:
        """Has each sighting count by how well it fits under a lamp."""
        self._weights = robust_weights(self.differences(vector), self.scale)

    def descend(self, vector: Floats) -> tuple[Floats, float, float] | None:
        """Returns where Gauss-Newton ends from a start, its cost and condition; None if it leads nowhere."""
        self._weights = np.ones(len(self.points))
        hessian = np.eye(3)
        for _ in range(STEPS):
            self.weigh(vector)
            residual, own, light = self._residual(vector, self._weights)
            lit = self.normals * (self.normals @ vector > 0.0)[:, None]
            # what the points' own colours take over of a change of the lamp is no error
            taken = self._means(self._weights, light, lit)
            change = lit - light[:, None] * taken[self.points]
            weighted = change * self._weights[:, None]
            hessian = (weighted * (own**2).sum(axis=1)[:, None]).T @ change
            gradient = weighted.T @ (residual * own).sum(axis=1)
            size = float(np.trace(hessian)) / 3.0
            if not size > 0.0:
                return None
            step = np.linalg.solve(hessian + DAMPING * size * np.eye(3), gradient)
            length = float(np.linalg.norm(step))
            vector = vector + step * min(1.0, LONGEST_STEP / max(length, SHORT))
            strength = float(np.linalg.norm(vector))
            vector = vector * min(1.0, STRONGEST / max(strength, SHORT))
            if length < SHORT:
                break
        low, *_, high = np.linalg.eigvalsh(hessian)
        return vector, self.cost(vector), float(high / max(low, 1e-12 * high))

    def _residual(self, vector: Floats, weights: Floats) -> tuple[Floats, Floats, Floats]:
        light = brightness(self.normals, vector)
        own = self._means(weights, light, self.colors)[self.points]
        return self.colors - own * light[:, None], own, light

    def _means(self, weights: Floats, light: Floats, values: Floats) -> Floats:
        """Returns what of values `[M, 3]` is alike in all sightings of a point, `[P, 3]`."""
        norm = np.maximum(np.bincount(self.points, weights * light**2, self.count), 1e-12)
        return sums(self.points, (weights * light)[:, None] * values, self.count) / norm[:, None]
