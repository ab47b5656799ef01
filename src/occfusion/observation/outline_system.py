"""All outlines of a sequence as one linear system: of knots of pose corrections, and of what is alike in all frames."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from occfusion.cpu.compilation import kernel
from occfusion.observation.arrow_system import ArrowFactor
from occfusion.observation.pose_witness import POSE_COLUMNS, Witness

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

STANDS_OFF, MEAN_STANDS_OFF = 0.015, 0.02
"""Metres: of a place of the body, and of all of it."""
SHAPE = 0.5
"""Standard deviations of the shape."""
SHIFT, SCALE = 0.01, 0.02
"""Of the person's size, and of the focal length: by how much the pictures lie off the cameras."""
KNOWN = 1e-6
"""Spread of what is known: no shift and no scale."""
NOISE = 0.2
"""Pixels, at least: the staircase of a binary mask."""
CORRELATED = 3.0
"""Neighbouring pixels of an outline err alike: at least so many count as one."""
BIWEIGHT = 4.7
COUPLED = 4
"""Knots of a cubic spline that a frame knows."""


class OutlineSystem:
    """The system, weighed and solved.

    Unknowns are the knots, `POSE_COLUMNS` each, then shift and scale of the pictures, the shape, what the body stands
    off as a whole, and what each place of it does.

    Args:
        seen: positions of frames, and what their outlines say.
        weights: how much each knot counts at each frame, `[T, K]`.
        patch: place of each vertex, `[V]`.
        values: of the knots, that outlines were looked for at, `[K, POSE_COLUMNS]`.
        registered: shift and scale are known.
        expected: of the unknowns that follow the knots, what other frames told: means and variances. The system's own
            are what they differ by.

    Attributes:
        count: unknowns of the knots.
        offsets: of all points, pixels.
        per_metre: pixels, at the person.
        focal: length, pixels.
        fixed_precision: of the unknowns that follow the knots.
        noise: standard deviation of outlines about the last fit, pixels.
        row_weights: of all points.
    """

    def __init__(
        self,
        seen: Sequence[tuple[int, Witness]],
        weights: Floats,
        patch: Ints,
        values: Floats,
        registered: bool,
        expected: tuple[Floats, Floats] | None = None,
    ) -> None:
        self._seen, self._spline_weights, self._patch = seen, weights, patch
        self.knots = len(values)
        self.count = self.knots * POSE_COLUMNS
        self.offsets = np.concatenate([w.offsets for _, w in seen])
        self._ends = np.cumsum([0] + [len(w.offsets) for _, w in seen])
        size = float(np.median([w.size for _, w in seen]))
        shapes, patches = seen[0][1].shape.shape[1], int(patch.max()) + 1
        self.per_metre = float(np.median(np.concatenate([w.per_metre for _, w in seen])))
        self.focal = seen[0][1].focal
        spread = np.full(3, KNOWN) if registered else np.array([SHIFT * size, SHIFT * size, SCALE])
        self.fixed_precision = np.concatenate(
            [
                spread**-2.0,
                np.full(shapes, SHAPE**-2.0),
                [MEAN_STANDS_OFF**-2.0],
                np.full(patches, STANDS_OFF**-2.0),
            ]
        )
        self._extra = len(self.fixed_precision)
        # what outlines would say of the poses as given
        self._targets = self.offsets.copy()
        for n, (k, w) in enumerate(seen):
            own = self._targets[self._ends[n] : self._ends[n + 1]]
            own += w.turns @ (weights[k] @ values)
            if expected is not None:
                own -= self._alike_part(w, expected[0])
        if expected is not None:
            self.fixed_precision = np.maximum(self.fixed_precision, 1.0 / expected[1])
        self._rows = [np.concatenate([w.turns, _few(w)], axis=1) for _, w in seen]
        self._residual = self.offsets - np.median(self.offsets)
        self.noise = NOISE
        self.row_weights = np.ones(len(self.offsets))

    def weigh(self) -> None:
        """Weighs rows by how well they fit (Tukey's biweight), and by how alike neighbours' errors are."""
        self.noise = max(1.4826 * float(np.median(np.abs(self._residual))), NOISE)
        weights = np.clip(1.0 - (self._residual / (BIWEIGHT * self.noise)) ** 2, 0.0, None) ** 2
        self.row_weights = weights / (self._alike(weights) * self.noise**2)
        self._assemble()

    def weigh_as(self, other: OutlineSystem) -> None:
        """Weighs rows as another system of the same outlines does, so that the two may be compared."""
        self.noise, self.row_weights = other.noise, other.row_weights
        self._assemble()

    def _alike(self, weights: Floats) -> float:
        """Returns how many points of an outline count as one, by how alike errors are in a place of a frame."""
        found = []
        for n, (_, w) in enumerate(self._seen):
            own = slice(self._ends[n], self._ends[n + 1])
            place = self._patch[w.vertices]
            count = np.bincount(place, weights[own])
            total = np.bincount(place, weights[own] * self._residual[own])
            many = count > 2.0
            found.append(total[many] ** 2 / count[many])
        each = np.concatenate(found)
        return (
            max(CORRELATED, float(np.mean(np.minimum(each, np.percentile(each, 90)))) / self.noise**2)
            if len(each)
            else CORRELATED
        )

    def settle(self, solution: Floats) -> None:
        """Takes the residual about a solution."""
        self._residual = self._targets - self._predicted(solution)

    def _predicted(self, solution: Floats) -> Floats:
        values, extra = solution[: self.count].reshape(self.knots, -1), solution[self.count :]
        parts = []
        for k, w in self._seen:
            parts.append(w.turns @ (self._spline_weights[k] @ values) + self._alike_part(w, extra))
        return np.concatenate(parts)

    def _alike_part(self, w: Witness, extra: Floats) -> Floats:
        """Returns what the unknowns that follow the knots give at the points of a frame, pixels."""
        few = _few(w)
        return few @ extra[: few.shape[1]] + w.per_metre * extra[few.shape[1] + self._patch[w.vertices]]

    def _assemble(self) -> None:
        """Forms the normal equations; each row knows one place alone of those that stand off.

        Knots of a cubic spline are coupled to the three that follow, so that knots in threes make a chain.
        """
        total, size = self.count + self._extra, POSE_COLUMNS
        near, right = np.zeros((self.knots, COUPLED, size, size)), np.zeros(total)
        patches = int(self._patch.max()) + 1
        border, corner = np.zeros((self.knots, size, self._extra)), np.zeros((self._extra, self._extra))
        few, places = slice(0, self._extra - patches), slice(self._extra - patches, self._extra)
        extra = right[self.count :]
        diagonal = np.zeros(patches)
        for n, (k, w) in enumerate(self._seen):
            own = slice(self._ends[n], self._ends[n + 1])
            rows, place = self._rows[n], self._patch[w.vertices]
            weighted = rows * self.row_weights[own, None]
            block, part = weighted.T @ rows, weighted.T @ self._targets[own]
            pull = self.row_weights[own] * w.per_metre
            active = np.flatnonzero(self._spline_weights[k])
            by_place = np.zeros((rows.shape[1], patches))
            _add_by_place(place, w.per_metre, weighted, by_place)
            _add_by_knots(active, self._spline_weights[k], block, part, by_place, near, border, right)
            corner[few, few] += block[size:, size:]
            corner[few, places] += by_place[size:]
            diagonal += np.bincount(place, pull * w.per_metre, patches)
            extra[few] += part[size:]
            extra[places] += np.bincount(place, pull * self._targets[own], patches)
        corner[places, places] = np.diag(diagonal)
        corner[places, few] = corner[few, places].T
        self._near, self._border, self._corner, self._right = near, border, corner, right

    def solve(self, precision: Floats) -> Floats:
        """Returns the most likely unknowns."""
        factor, scale = self._factor(precision)
        return scale * factor.solve(scale * self._right)

    def solve_with_variance(self, precision: Floats) -> tuple[Floats, Floats]:
        """Returns the most likely unknowns and their variances, which cost twice as much again."""
        factor, scale = self._factor(precision)
        return scale * factor.solve(scale * self._right), factor.variance() * scale**2

    def evidence(self, precision: Floats) -> float:
        """Returns the logarithm of how likely outlines are whatever the unknowns, but for what is alike for all priors.

        MacKay, "Bayesian interpolation", 1992: of two systems with the same rows and weights, the difference is that of
        their marginal likelihoods.
        """
        factor, scale = self._factor(precision)
        solution = scale * factor.solve(scale * self._right)
        misfit = float((self.row_weights * (self._targets - self._predicted(solution)) ** 2).sum())
        return -0.5 * (misfit + float((precision * solution**2).sum()) + factor.log_determinant())

    def _scaled(self, rows: range, columns: range, scale: Floats) -> Floats:
        """Returns the block of some knots by others, in units of their scale."""
        out = np.empty((len(rows), POSE_COLUMNS, len(columns), POSE_COLUMNS))
        _join(self._near, rows.start, columns.start, scale, out)
        return out.reshape(len(rows) * POSE_COLUMNS, len(columns) * POSE_COLUMNS)

    def _factor(self, precision: Floats) -> tuple[ArrowFactor, Floats]:
        # in units of the prior's spread the system is well scaled whatever it is
        scale = precision**-0.5
        knots, extra = scale[: self.count].reshape(self.knots, -1), scale[self.count :]
        border = self._border * knots[..., None] * extra
        diagonal, below, edges = [], [], []
        groups = [range(a, min(a + COUPLED - 1, self.knots)) for a in range(0, self.knots, COUPLED - 1)]
        for own, following in pairwise([*groups, range(0)]):
            diagonal.append(self._scaled(own, own, knots))
            diagonal[-1].ravel()[:: len(diagonal[-1]) + 1] += 1.0
            edges.append(border[own.start : own.stop].reshape(len(own) * POSE_COLUMNS, len(extra)))
            if following:
                below.append(self._scaled(following, own, knots))
        corner = self._corner * extra[:, None] * extra + np.eye(len(extra))
        return ArrowFactor(diagonal, below, edges, corner), scale


@kernel
def _add_by_place(places: Ints, per_metre: Floats, weighted: Floats, out: Floats) -> None:
    """Adds rows of points to the columns of the places that they are of, `[columns, places]`."""
    for n in range(len(places)):
        for column in range(weighted.shape[1]):
            out[column, places[n]] += per_metre[n] * weighted[n, column]


@kernel
def _add_by_knots(
    active: Ints,
    weights: Floats,
    block: Floats,
    part: Floats,
    by_place: Floats,
    near: Floats,
    border: Floats,
    right: Floats,
) -> None:
    """Adds a frame's equations to those of the knots that it knows.

    Args:
        active: these knots, ascending.
        weights: how much each knot counts, `[K]`.
        block: of the knots' columns, then those of what is alike in all frames but places.
        part: right side of the same.
        by_place: the same columns by places.
        near: of knots by those that follow, `[K, COUPLED, columns, columns]`.
        border: of knots by what is alike, `[K, columns, extra]`.
        right: right side.
    """
    size, few, patches = near.shape[2], block.shape[0] - near.shape[2], by_place.shape[1]
    for a in active:
        for i in range(size):
            right[a * size + i] += weights[a] * part[i]
            for j in range(few):
                border[a, i, j] += weights[a] * block[i, size + j]
            for j in range(patches):
                border[a, i, few + j] += weights[a] * by_place[i, j]
        for b in active:
            if b < a:
                continue
            share = weights[a] * weights[b]
            for i in range(size):
                for j in range(size):
                    near[a, b - a, i, j] += share * block[i, j]


@kernel
def _join(near: Floats, first_row: int, first_column: int, scale: Floats, out: Floats) -> None:
    """Gives the block of some knots by others, in units of their scale `[K, columns]`.

    Args:
        near: of knots by those that follow, `[K, COUPLED, columns, columns]`.
        first_row: of the knots of the rows.
        first_column: of the knots of the columns.
        scale: of each unknown, `[K, columns]`.
        out: `[rows, columns, columns of the knots, columns]`; what lies farther than the spline reaches is zero.
    """
    for i in range(out.shape[0]):
        for j in range(out.shape[2]):
            a, b = first_row + i, first_column + j
            for p in range(out.shape[1]):
                for q in range(out.shape[3]):
                    if b >= a:
                        value = near[a, b - a, p, q] if b - a < COUPLED else 0.0
                    else:
                        value = near[b, a - b, q, p] if a - b < COUPLED else 0.0
                    out[i, p, j, q] = value * scale[a, p] * scale[b, q]


def _few(w: Witness) -> Floats:
    """Returns what shift and scale of the pictures, shape and standing off as a whole give, `[N, 4 + B]`, pixels."""
    return np.column_stack([w.picture, w.shape, w.per_metre])
