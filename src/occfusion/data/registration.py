"""Are the pictures where the cameras say? A constant shift and scale of the person against the projected body.

A principal point that counts pixels from another corner, a crop or a resampling that the calibration does not know
of, a focal length that is off: all frames of a camera then show the person shifted by the same pixels, or scaled
about the same point. At 256 px, half a pixel costs an exact scene more than five decibels.

Clothes, hair and shoes stand off the body as well, but with the body: what stands off to the left in one frame does
so to the right once the person has turned. So the offsets between the outlines of body and mask are explained by both
at once:

    offset = normal . (shift + scale (point - principal point)) + f / depth (mean + part[v] + patch[v]) + noise

`part` and `patch` are what stands off at 24 and 300 places of the body. A normal prior of a centimetre on each keeps
what the frames cannot tell apart out of the shift, and shows in its error. The fit is robust (Tukey's biweight): an
occluder's edge is no outline. The error is that of leaving out tenths of the video in turn, since errors of
neighbouring poses are alike, and of the prior, and of what was measured on people whose cameras are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse
from scipy.spatial import cKDTree

from occfusion.data.outline_offsets import NONE, Correction, Floats, Ints, Offsets, View, measure_offsets

PARTS, PATCHES = 24, 300
STANDS_OFF = 0.01
"""Metres: what clothes, hair and shoes of a part, or of a patch of it, stand off more or less than others."""
MEAN_STANDS_OFF = 0.02
"""Metres: of the person as a whole."""
MISPLACED = 0.05
"""Metres along each axis: by how much an estimator puts a whole body elsewhere."""
CORRELATED = 3.0
"""Neighbouring pixels of an outline err alike: so many of them count as one."""
LEAST_NOISE = 0.2
"""Pixels: the staircase of a binary mask."""
BIWEIGHT = 4.7
"""Standard deviations beyond which Tukey's biweight gives no weight."""
ITERATIONS = 15
ROUNDS, SETTLED = 6, 0.02
"""Outlines are looked for anew where the correction puts them, until it moves by less than so many pixels."""
BLOCKS, LEAST_BLOCKS = 10, 5
LEAST_POINTS = 1000
"""Fewer points of the outline tell too little."""
MOST_NOISE = 0.015
"""Of the person's size: outlines that agree no better are not of the same thing. Embedded people have 0.001 where poses
are exact and 0.01 at most where they are estimated; masks of random pixels have 0.023."""
MOST_FRAMES = 100
CERTAIN, SUSPECTED, LIKELY = 5.0, 3.0, 2.0
"""Errors from which on something is off for certain; from which on other cameras are asked whether they see it too; and
from which on, where something is off, a part of it is taken. Poses that an estimator gave wander about the truth, and
not quite about it: embedded people with such poses and exact cameras have 4.8 at most (docs/method/registration.md)."""
SHIFT_DIGITS, SCALE_DIGITS = 3, 5
"""A correction is rounded, so that another machine's last digits make no other run of it."""
SYSTEMATIC_SHIFT = 3e-4
"""Of the person's size. Eleven embedded people below number 100 with exact cameras: 0.02 px across and 0.09 px down
at most, of 190 (docs/method/registration.md)."""
SYSTEMATIC_SCALE = 1.2e-3
"""The same people: 0.0014 at most."""


@dataclass(frozen=True)
class Registration:
    """How far pictures lie off the cameras, measured.

    Attributes:
        shift: x and y, pixels.
        scale: of the pictures about the principal point, less 1.
        shift_error: standard errors of `shift`.
        scale_error: of `scale`.
        correction: what is certain of it, or likely where something is; nothing if nothing is certain.
        suspected: a shift of lower certainty, for other cameras to confirm. No scale, which they cannot: a body of the
            wrong size is too large in all of them.
        frames: pictures that were measured.
        points: of outlines in them.
    """

    shift: tuple[float, float]
    scale: float
    shift_error: tuple[float, float]
    scale_error: float
    correction: Correction
    suspected: Correction
    frames: int
    points: int

    def text(self) -> str:
        """Returns the measurement in words."""
        (x, y), (ex, ey) = self.shift, self.shift_error
        return (
            f"pictures lie ({x:+.2f} ± {ex:.2f}, {y:+.2f} ± {ey:.2f}) px off the projected body, scaled by "
            f"{1 + self.scale:.4f} ± {self.scale_error:.4f} ({self.frames} frames)"
        )


def register(views: Sequence[View], faces: Ints, rest: Floats) -> Registration | None:
    """Returns how far the pictures of a camera lie off it; None where outlines tell too little.

    Args:
        views: of one camera, in the order of time.
        faces: of the body, `[F, 3]`.
        rest: its vertices at rest, `[V, 3]`, metres.
    """
    if not np.isfinite(rest).all():
        return None
    places, total = _places(rest), np.zeros(3)
    for _ in range(ROUNDS):
        base = total
        x, y, scale = base.tolist()
        data = measure_offsets(views, faces, Correction((x, y), scale))
        blocks = _blocks(data.groups)
        if len(data) < LEAST_POINTS or len(np.unique(blocks)) < LEAST_BLOCKS:
            return None
        fit = _Fit(data, places)
        total = base + fit.unknowns
        if (np.abs(total - base) * (1.0, 1.0, data.size)).max() < SETTLED:
            break
    if fit.noise > MOST_NOISE * data.size:
        return None
    error = fit.errors(blocks, data.size)
    x, y, scale = total.tolist()
    return Registration(
        shift=(x, y),
        scale=scale,
        shift_error=(float(error[0]), float(error[1])),
        scale_error=float(error[2]),
        correction=_taken(total, error, CERTAIN),
        suspected=_taken(total * (1.0, 1.0, 0.0), error, SUSPECTED),
        frames=len(views),
        points=len(data),
    )


def agreement(
    views: Sequence[View],
    corrections: Sequence[Correction],
    faces: Ints,
    rest: Floats,
    *,
    or_misplaced: bool = False,
) -> tuple[float, float] | None:
    """Returns how much of a correction other cameras ask for: 1 all of it, 0 nothing; and its standard error.

    Args:
        views: of other cameras; `group` is the camera.
        corrections: the same correction, at the size of each view.
        faces: of the body, `[F, 3]`.
        rest: its vertices at rest, `[V, 3]`, metres.
        or_misplaced: the body may lie elsewhere in the world instead; only what that does not explain is asked for.

    Returns:
        None where outlines tell too little.
    """
    data = measure_offsets(views, faces, Correction())
    if len(data) < LEAST_POINTS:
        return None
    by_group = {view.group: correction for view, correction in zip(views, corrections, strict=True)}
    amounts = np.array([[*by_group[int(g)].shift, by_group[int(g)].scale] for g in data.groups])
    along = (data.fields * amounts).sum(axis=1, keepdims=True)
    held = np.zeros(1)
    if or_misplaced:
        along, held = np.column_stack([along, data.moves]), np.array([0.0, *[MISPLACED**-2] * 3])
    fit = _Fit(replace(data, fields=along), _places(rest), held)
    groups = np.unique(data.groups)
    blocks = np.searchsorted(groups, data.groups) % min(BLOCKS, len(groups))
    spread = fit.left_out(blocks) if len(groups) > 1 else np.zeros(len(held))
    return float(fit.unknowns[0]), float(np.sqrt(spread + fit.prior_variance())[0])


def _places(rest: Floats) -> tuple[Ints, Ints]:
    """Returns part and patch of each vertex, `[V]` each: evenly spread over the body at rest."""
    return _nearest(rest, PARTS), _nearest(rest, PATCHES)


def _nearest(rest: Floats, count: int) -> Ints:
    """Returns the nearest of `count` vertices that lie as far from each other as can be, for each vertex."""
    chosen, away = [0], np.linalg.norm(rest - rest[0], axis=1)
    while len(chosen) < min(count, len(rest)):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(rest - rest[chosen[-1]], axis=1))
    return np.asarray(cKDTree(rest[chosen]).query(rest)[1], dtype=np.int64)


def _blocks(groups: Ints) -> Ints:
    """Returns which tenth of the video each point is of."""
    moments = np.unique(groups)
    return np.searchsorted(moments, groups) * BLOCKS // max(len(moments), 1)


class _Fit:
    """The robust fit: a Gaussian posterior of the unknowns, and of what stands off.

    Args:
        data: what is fitted.
        places: part and patch of each vertex.
        held: precisions about 0 of the unknowns; none when None.

    Attributes:
        count: number of unknowns.
        noise: standard deviation of the offsets about the fit, robustly, pixels.
    """

    def __init__(self, data: Offsets, places: tuple[Ints, Ints], held: Floats | None = None) -> None:
        part, patch = (place[data.vertices] for place in places)
        parts, patches = int(places[0].max()) + 1, int(places[1].max()) + 1
        rows, per_metre = np.arange(len(data)), data.pixels_per_metre
        self.count = data.fields.shape[1]
        self._terms = scipy.sparse.hstack(
            [
                scipy.sparse.csr_matrix(np.column_stack([data.fields, per_metre])),
                scipy.sparse.csr_matrix((per_metre, (rows, part)), shape=(len(data), parts)),
                scipy.sparse.csr_matrix((per_metre, (rows, patch)), shape=(len(data), patches)),
            ]
        ).tocsr()
        self._offsets = data.offsets
        self._prior = np.concatenate(
            [
                np.zeros(self.count) if held is None else held,
                [MEAN_STANDS_OFF**-2],
                np.full(parts + patches, STANDS_OFF**-2),
            ]
        )
        self._weights = self._robust_weights()
        self._normal, self._right = self._equations(slice(None))

    @cached_property
    def unknowns(self) -> Floats:
        """The most likely values, as many as there are fields."""
        solved = np.linalg.solve(self._normal + np.diag(self._prior), self._right)
        return np.asarray(solved[: self.count])

    def errors(self, blocks: Ints, size: float) -> Floats:
        """Returns the standard errors of shift and scale."""
        systematic = np.array([SYSTEMATIC_SHIFT * size, SYSTEMATIC_SHIFT * size, SYSTEMATIC_SCALE])
        return np.asarray(np.sqrt(self.left_out(blocks) + self.prior_variance() + systematic**2))

    def prior_variance(self) -> Floats:
        """Returns what noise of single pixels, and what may stand off, leave open of the unknowns."""
        inverse = np.linalg.inv(self._normal + np.diag(self._prior))
        return np.asarray(np.diag(inverse)[: self.count])

    def left_out(self, blocks: Ints) -> Floats:
        """Returns the variance of the unknowns by the jackknife over blocks."""
        found = []
        for block in np.unique(blocks):
            normal, right = self._equations(np.flatnonzero(blocks == block))
            solved = np.linalg.solve(self._normal - normal + np.diag(self._prior), self._right - right)
            found.append(solved[: self.count])
        each = np.array(found)
        return np.asarray((len(each) - 1) * each.var(axis=0))

    def _robust_weights(self) -> Floats:
        residual = self._offsets - np.median(self._offsets)
        weights = np.ones(len(residual))
        for iteration in range(ITERATIONS):
            self.noise = max(1.4826 * float(np.median(np.abs(residual))), LEAST_NOISE)
            if iteration:
                weights = np.clip(1.0 - (residual / (BIWEIGHT * self.noise)) ** 2, 0.0, None) ** 2
            weights = weights / (CORRELATED * self.noise**2)
            self._weights = weights
            normal, right = self._equations(slice(None))
            residual = self._offsets - self._terms @ np.linalg.solve(normal + np.diag(self._prior), right)
        return weights

    def _equations(self, rows: Ints | slice) -> tuple[Floats, Floats]:
        terms, weights = self._terms[rows], self._weights[rows]
        weighted = terms.multiply(weights[:, None]).tocsr()
        return (terms.T @ weighted).toarray(), np.asarray(weighted.T @ self._offsets[rows])


def _taken(total: Floats, error: Floats, least: float) -> Correction:
    """Returns nothing, or all that is likely where something has a certainty of `least`. A shift is taken whole."""
    certainty = np.abs(total) / error
    if certainty.max() < least:
        return NONE
    is_shifted, is_scaled = certainty[:2].max() >= LIKELY, certainty[2] >= LIKELY
    x, y, scale = total * (is_shifted, is_shifted, is_scaled)
    return Correction(
        (round(float(x), SHIFT_DIGITS), round(float(y), SHIFT_DIGITS)), round(float(scale), SCALE_DIGITS)
    )
