"""Poses put right by the outlines of masks, as far as these tell: before anything is trained.

What an estimator got wrong is a smooth function of time: knots of a cubic B-spline, for each angle of each joint and
for the place. The poses as given are the mean of a normal prior on them, and its spread is what the video itself makes
most likely (MacKay, "Bayesian interpolation", 1992), for each part of the body by itself. Where poses are exact the
spread comes out as next to nothing, and nothing moves; angles that outlines hardly tell stay where they are, whatever
the others do. That takes a curvature: Gauss-Newton over the whole sequence, looking for outlines anew from where it has
got to.

Clothes, hair and a wrong shape stand off the body as well. They do so with the body, in all frames alike: what each
of 150 places stands off, and the shape, are unknowns too, and so are a shift and a scale of the pictures. What is
misfit of them is not taken for misfit of poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from occfusion.cpu.workers import threaded_map
from occfusion.human.body import Body
from occfusion.human.pose_spline import PoseSpline
from occfusion.observation.outline_system import OutlineSystem
from occfusion.observation.pose_alignment import GROUPS, WORTH, Alignment
from occfusion.observation.pose_witness import (
    POSE_COLUMNS,
    REACH,
    Look,
    Witness,
    misfits,
    observe_outline,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

PATCHES = 150
"""Places of the body: twice as many cost half as much again, and joints come no nearer."""
CARRIED = {"head": "trunk", "feet": "knees", "hands": "elbows"}
"""Ends of the body, each off by no more than what carries it: hair, shoes and fingers change their outlines most, and a
turned head explains hair."""
FIRST_TURN, FIRST_PLACE = 0.03, 0.01
"""Radians and metres: spreads that the search begins with."""
LEAST_TURN, LEAST_PLACE = 1e-4, 1e-4
"""Spreads below which nothing is told from nothing."""
MOST_TURN, MOST_PLACE = 0.06, 0.04
"""Spreads that no estimator exceeds whose poses are of any use. Of somebody who does not turn, a pose that is off
throughout and clothes that stand off can explain each other without end."""
ROUNDS, SETTLING, EVIDENCE_STEPS = 3, 2, 2
"""Looks at outlines with shift and scale of the pictures unknown, then without; estimates of the spreads in each."""
LOOKS_A_KNOT = 2
"""Frames that are looked at for each knot: more say the same again, and cost as much."""
AMOUNTS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Of the correction, that are tried on places of the body that it was not found by."""
LEAST_FRAMES = 4


@dataclass(frozen=True)
class Common:
    """What is alike in all frames of a sequence, as a part of it tells.

    Attributes:
        spreads: of the corrections, one for each of `GROUPS` and one for the place.
        unknowns: of an `OutlineSystem`, those that follow the knots.
        variances: of them.
    """

    spreads: Floats
    unknowns: Floats
    variances: Floats


class Aligner:
    """The search, at some frames of a sequence; knots that none of them knows stay where they are.

    Args:
        looks: at frames of one camera, in order of time.
        body: of their poses.
        spline: of the whole sequence.
        registered: shift and scale of the pictures are known: cameras are corrected.
        common: what other frames told; None: it is found.

    Attributes:
        values: of the knots that the frames know, `[K', 75]`.
        spreads: of the corrections, one for each of `GROUPS` and one for the place.
        noise: of outlines about the fit, pixels of the masks.
    """

    def __init__(
        self,
        looks: Sequence[Look],
        body: Body,
        spline: PoseSpline,
        *,
        registered: bool = False,
        common: Common | None = None,
    ) -> None:
        self._spline, self._looks, self._body, self._registered = spline, looks, body, registered
        weights = np.stack([spline_weights(spline, look.index) for look in looks])
        self._known = np.flatnonzero(weights.any(axis=0))
        self._weights = weights[:, self._known]
        self._knots = len(self._known)
        rest = body.rest(looks[0].pose.betas).vertices.double().cpu().numpy()
        self._patch = _patches(rest.tobytes(), PATCHES)
        self._left_out = self._patch % 2 == 1
        self._count = self._knots * POSE_COLUMNS
        group = np.zeros(POSE_COLUMNS, np.int64)
        for number, joints in enumerate(GROUPS.values()):
            for joint in joints:
                group[3 * joint : 3 * joint + 3] = number
        group[72:] = len(GROUPS)
        self._group = np.tile(group, self._knots)
        self.spreads = np.full(len(GROUPS) + 1, FIRST_TURN)
        self.spreads[-1] = FIRST_PLACE
        self._common = common
        if common is not None:
            self.spreads = common.spreads.copy()
        self.values = np.zeros((self._knots, POSE_COLUMNS))
        self._solution: Floats | None = None
        self.before = 0.0

    def run(self, settling: int = SETTLING) -> Alignment | None:
        """Returns the alignment; None where outlines tell too little.

        Args:
            settling: looks of all frames, with shift and scale of the pictures known, behind those of a half.
        """
        picture, picture_error, everyone = np.zeros(3), np.ones(3), range(len(self._looks))
        half, kept = everyone[::2], ~self._left_out
        few = (
            half if len(half) >= LOOKS_A_KNOT * (self._knots - 3) else everyone
        )  # a knot lies on either side
        for number in range(ROUNDS):
            reach = 2.0 * REACH if number == 0 else REACH
            if not self._step(few, reach, self._registered, kept):
                return None
            if not self._registered:
                picture, picture_error = self._picture
        if not self._step(few, REACH, True, kept):
            return None
        amount, gain = self._best_amount(few)
        for _ in range(settling if amount else 0):  # what is not taken need not be found to the end
            if not self._step(everyone, REACH, True):
                return None
        pixel = self._looks[0].pixel
        sides = np.array([pixel, pixel, 1.0])
        knots = self._spline.knots
        turns, places, told = np.zeros((knots, 24, 3)), np.zeros((knots, 3)), np.zeros((knots, 24, 3))
        self.into(turns, places, told, range(knots))
        return Alignment(
            turns=amount * turns,
            places=amount * places,
            spreads=dict(zip((*GROUPS, "place"), self.spreads.tolist(), strict=True)),
            amount=amount,
            gain=gain,
            told=told,
            first=self._spline.first,
            spacing=self._spline.spacing,
            picture=picture * sides,
            picture_error=picture_error * sides,
            noise=self.noise * pixel,
            before=self.before * pixel,
        )

    def settle(self) -> bool:
        """Finds the knots, where other frames told what is alike; returns whether outlines tell enough.

        Spreads are near what they will be: they are asked for with the last look alone.
        """
        everyone = range(len(self._looks))
        return all(self._step(everyone, REACH, True, spreads=k == SETTLING - 1) for k in range(SETTLING))

    @property
    def common(self) -> Common:
        """What other frames of the sequence may take over."""
        return Common(self.spreads, *self._alike)

    @property
    def told(self) -> Floats:
        """Share of each value that outlines tell, 0 to 1, `[K', 75]`."""
        left = self._variance / self.spreads[self._group] ** 2
        return np.clip(1.0 - left, 0.0, 1.0).reshape(self._knots, POSE_COLUMNS)

    def into(self, turns: Floats, places: Floats, told: Floats, own: range) -> None:
        """Puts what was found into arrays of all knots.

        Args:
            turns: `[K, 24, 3]`.
            places: `[K, 3]`.
            told: `[K, 24, 3]`.
            own: knots that are put there.
        """
        taken = (self._known >= own.start) & (self._known < own.stop)
        where = self._known[taken]
        turns[where] = self.values[taken, :72].reshape(-1, 24, 3)
        places[where] = self.values[taken, 72:]
        told[where] = self.told[taken, :72].reshape(-1, 24, 3)

    def correction(self, position: int) -> tuple[Floats, Floats]:
        """Returns turns `[24, 3]` and shift `[3]` of a frame by its position."""
        value = self._weights[position] @ self.values
        return value[:72].reshape(24, 3), value[72:]

    def _best_amount(self, positions: Sequence[int]) -> tuple[float, float]:
        """Returns how much of the correction is taken, and the share of the misfit with masks that goes with the best.

        At places of the body that it was not found by, every other one; nothing is taken where that is not worth it.
        Other frames would not do: where they lie farther apart than errors last they say nothing of each other, and
        edges of masks that are off stay so for some frames.
        """

        def errors(k: int) -> Floats:
            turns, shift = self.correction(k)
            amounts = [(amount * turns, amount * shift) for amount in AMOUNTS]
            return misfits(self._body, self._looks[k], amounts, self._left_out)

        misfit = np.mean(list(threaded_map(errors, positions, torch.get_num_threads())), axis=0)
        best = int(misfit.argmin())
        gain = 1.0 - float(misfit[best]) / max(float(misfit[0]), 1e-12)
        return (AMOUNTS[best] if gain >= WORTH else 0.0), gain

    def _step(
        self,
        positions: Sequence[int],
        reach: float,
        registered: bool,
        kept: NDArray[np.bool_] | None = None,
        *,
        spreads: bool = True,
    ) -> bool:
        """Looks for outlines and solves for what they say; returns whether they tell enough.

        Without `spreads` these, and how far values are told, stay as they are.
        """
        seen = self.observe(positions, reach, kept)
        if len(seen) < min(LEAST_FRAMES, len(positions)):
            return False
        told = self._common
        expected = None if told is None else (told.unknowns, told.variances)
        system = OutlineSystem(seen, self._weights, self._patch, self.values, registered, expected)
        if not self.before:
            self.before = 1.4826 * float(np.median(np.abs(system.offsets)))
        if self._solution is None or told is None:
            self._weigh(system)
        else:  # about where the last look has left it
            system.settle(self._solution)
            self._weigh(system, 1)
        if not spreads:
            self._take(system.solve(self._precision(system)))
            return True
        solution, variance = self._find_spreads(system, EVIDENCE_STEPS if told is None else 1)
        few = slice(self._count, self._count + 3)
        as_place = self.spreads[-1] * system.per_metre * np.array([1.0, 1.0, 1.0 / system.focal])
        self._picture = solution[few], np.sqrt(variance[few] + as_place**2)
        self._take(solution)
        self._alike = solution[self._count :], variance[self._count :]
        self._variance, self.noise = variance[: self._count], system.noise
        return True

    def _take(self, solution: Floats) -> None:
        self._solution = solution
        self.values = solution[: self._count].reshape(self._knots, POSE_COLUMNS)

    def observe(
        self, positions: Sequence[int], reach: float, kept: NDArray[np.bool_] | None = None
    ) -> list[tuple[int, Witness]]:
        """Returns what outlines say about the bodies as they are corrected so far, of frames that show any.

        Args:
            positions: of the frames.
            reach: as in `observe_outline`.
            kept: vertices whose points of an outline are taken, `[V]`; None: all.
        """

        def witness_of(k: int) -> Witness | None:
            witness = observe_outline(self._body, self._looks[k], self.correction(k), reach)
            return witness if witness is None or kept is None else witness.only(kept[witness.vertices])

        found = threaded_map(witness_of, positions, torch.get_num_threads())
        return [(k, witness) for k, witness in zip(positions, found, strict=True) if witness is not None]

    def _precision(self, system: OutlineSystem) -> Floats:
        return np.concatenate([self.spreads[self._group] ** -2.0, system.fixed_precision])

    def _weigh(self, system: OutlineSystem, rounds: int = 2) -> None:
        """Weighs outlines by the residual about their fit."""
        for _ in range(rounds):
            system.weigh()
            system.settle(system.solve(self._precision(system)))
        system.weigh()

    def _find_spreads(self, system: OutlineSystem, steps: int = EVIDENCE_STEPS) -> tuple[Floats, Floats]:
        """Makes the spreads likelier; returns the unknowns and their variances."""
        for _ in range(steps):
            solution, variance = system.solve_with_variance(self._precision(system))
            self._update_spreads(solution[: self._count], variance[: self._count])
        return solution, variance

    def likelihood(
        self, seen: Sequence[tuple[int, Witness]], weighed: OutlineSystem | None
    ) -> tuple[float, OutlineSystem]:
        """Returns the evidence of knots as they lie, with the spreads that it is largest for, and the weighed outlines.

        Args:
            seen: outlines about the poses as given.
            weighed: a system of them whose weights are taken; None: they are found.
        """
        system = OutlineSystem(seen, self._weights, self._patch, self.values, self._registered)
        if weighed is None:
            self._weigh(system)
        else:
            system.weigh_as(weighed)
        for _ in range(2):
            self._find_spreads(system)
        return system.evidence(self._precision(system)), system

    def _update_spreads(self, values: Floats, variance: Floats) -> None:
        """Gives each group the spread that makes what is seen most likely, one step of MacKay's."""
        for number in range(len(self.spreads)):
            own = self._group == number
            told = float((1.0 - variance[own] / self.spreads[number] ** 2).clip(0.0, 1.0).sum())
            spread = np.sqrt(float((values[own] ** 2).sum()) / max(told, 1e-3))
            is_place = number == len(GROUPS)
            least, most = (LEAST_PLACE, MOST_PLACE) if is_place else (LEAST_TURN, MOST_TURN)
            # a step of MacKay's may leap: by a factor of four at most
            near = np.clip(spread, 0.25 * self.spreads[number], 4.0 * self.spreads[number])
            self.spreads[number] = np.clip(near, least, most)
        names = list(GROUPS)
        for end, carrier in CARRIED.items():
            outer, inner = names.index(end), names.index(carrier)
            self.spreads[outer] = min(self.spreads[outer], self.spreads[inner])


def align_poses(
    looks: Sequence[Look], body: Body, spline: PoseSpline, *, registered: bool = False
) -> Alignment | None:
    """Returns what outlines say of the poses of training frames; None where they tell too little.

    Args:
        looks: at training frames, in order of time.
        body: of their poses.
        spline: over the training frames.
        registered: shift and scale of the pictures are known.
    """
    if len(looks) < LEAST_FRAMES:
        return None
    return Aligner(looks, body, spline, registered=registered).run()


def spline_weights(spline: PoseSpline, frame: float) -> Floats:
    """Returns how much each knot counts at a frame, `[K]`."""
    start, shares = spline.weights_at(frame)
    out = np.zeros(spline.knots)
    out[start : start + 4] = shares
    return out


@lru_cache(2)  # a sequence has many aligners, and one shape
def _patches(rest: bytes, count: int) -> Ints:
    """Returns the place of each vertex, `[V]`: places lie as far from each other as can be.

    Args:
        rest: the vertices, float64 `[V, 3]`.
        count: of the places, at most.
    """
    vertices = np.frombuffer(rest).reshape(-1, 3)
    chosen, away = [0], np.linalg.norm(vertices - vertices[0], axis=1)
    while len(chosen) < min(count, len(vertices)):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(vertices - vertices[chosen[-1]], axis=1))
    found = np.asarray(cKDTree(vertices[chosen]).query(vertices)[1], np.int64)
    found.flags.writeable = False  # all aligners have the same
    return found
