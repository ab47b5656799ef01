"""Poses put right by the outlines of masks, as far as these tell: before anything is trained.

What an estimator got wrong is a smooth function of time: knots of a cubic B-spline, for each angle of each joint and
for the place. The poses as given are the mean of a normal prior on them, and its spread is what the video itself makes
most likely (MacKay, "Bayesian interpolation", 1992), for each part of the body by itself. Where poses are exact the
spread comes out as next to nothing, and nothing moves; angles that outlines hardly tell stay where they are, whatever
the others do. That takes a curvature: Gauss-Newton over the whole sequence, looking for outlines anew from where it has
got to.

Clothes, hair and a wrong shape stand off the body as well. They do so with the body, in all frames alike: what each
of 300 places stands off, and the shape, are unknowns too, and so are a shift and a scale of the pictures. What is
misfit of them is not taken for misfit of poses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from occfusion.cpu.workers import threaded_map
from occfusion.geometry.rotation import matrix_to_quaternion
from occfusion.human.body import Body
from occfusion.human.pose_spline import PoseSpline
from occfusion.observation.outline_system import OutlineSystem
from occfusion.observation.pose_witness import (
    POSE_COLUMNS,
    REACH,
    Look,
    Witness,
    misfits,
    observe_outline,
)
from occfusion.types import Pose

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

PATCHES = 300
GROUPS: dict[str, tuple[int, ...]] = {
    "root": (0,), "trunk": (3, 6, 9, 12, 13, 14), "head": (15,), "hips": (1, 2), "knees": (4, 5),
    "feet": (7, 8, 10, 11), "shoulders": (16, 17), "elbows": (18, 19), "hands": (20, 21, 22, 23),
}  # fmt: skip
"""Joints whose errors are alike: each group has one spread, the place another."""
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
CERTAIN = 5.0
"""Standard deviations from which on pictures are certainly shifted or scaled, as in `data.registration`."""
FULL_TURN, FULL_PLACE = 0.02, 0.01
"""Radians and metres: spreads from which on training may move poses as fast as its rates say."""
LEAST_LOOKS, LOOKS_A_KNOT = 240, 2
"""Frames that are looked at of a long sequence, and for each knot: more say the same again, and cost as much
(docs/experiments/049-long-videos.md)."""
AMOUNTS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Of the correction, that are tried on places of the body that it was not found by."""
WORTH = 0.08
"""Of the misfit with masks there, the share that has to go before anything is taken: exact poses gain 1 %, 6 where mask
edges wander by pixels; estimators' poses gain 23 and more (docs/experiments/056-frames-far-apart.md)."""
LEAST_FRAMES = 4


@dataclass(frozen=True)
class Alignment:
    """What outlines say of the poses of a sequence.

    Attributes:
        turns: of the spline's knots, `[K, 24, 3]`, radians.
        places: `[K, 3]`, metres.
        spreads: standard deviation of what each group of joints, and the place, is off: radians, metres.
        amount: of what outlines ask for, that is taken: with it bodies fit masks best at places of the body that it was
            not found by. 0 where that is not worth it.
        gain: share of the misfit there that goes with the best amount.
        told: share of each turn that outlines tell, `[K, 24, 3]`, 0 to 1.
        first: of the spline.
        spacing: of the spline.
        picture: shift in x and y, pixels of the frames, and scale less 1, that pictures have beside the cameras, `[3]`.
        picture_error: standard deviations of `picture`; a body that is misplaced throughout by as much as it wanders
            explains it as well, and that is part of them.
        noise: of outlines about the fit, pixels of the frames.
        before: of outlines about the poses as given, the same.
    """

    turns: Floats
    places: Floats
    spreads: dict[str, float]
    amount: float
    gain: float
    told: Floats
    first: float
    spacing: float
    picture: Floats
    picture_error: Floats
    noise: float
    before: float

    @property
    def is_taken(self) -> bool:
        """Whether any of it is: else poses stay as they were given."""
        return self.amount > 0.0

    @property
    def shows_shift(self) -> bool:
        """Whether pictures are certainly shifted or scaled against the cameras, whatever the poses are."""
        return bool((np.abs(self.picture) > CERTAIN * self.picture_error).any())

    def spline(self) -> PoseSpline:
        """Returns the corrections, ready to be trained on: what the video hardly tells hardly moves."""
        made = PoseSpline(self.first, self.spacing, len(self.turns), aligned=True)
        group = np.zeros(24, np.int64)
        for number, joints in enumerate(GROUPS.values()):
            group[list(joints)] = number
        spreads = np.array(list(self.spreads.values()))
        reach = self.amount * self.told * np.minimum(1.0, spreads[group] / FULL_TURN)[:, None]
        place = np.full(self.places.shape, self.amount * min(1.0, spreads[-1] / FULL_PLACE))
        made.start_at(*(torch.from_numpy(part).float() for part in (self.turns, self.places, reach, place)))
        return made

    def text(self) -> str:
        """Returns what was found, in words."""
        turns = [value for name, value in self.spreads.items() if name != "place"]
        return (
            f"outlines lie {self.before:.2f} px off the poses as given and {self.noise:.2f} px off the aligned ones; "
            f"joints are off by {np.degrees(np.median(turns)):.1f} degrees, the place by "
            f"{1000 * self.spreads['place']:.0f} mm. Of the misfit with masks at places left out {self.gain:.1%} goes; "
            f"{self.amount:g} of it is taken, nothing below {WORTH:.0%}. A knot lies at every {self.spacing:.2g} frames"
        )


@torch.no_grad()
def aligned_pose(pose: Pose, spline: PoseSpline, body: Body) -> Pose:
    """Returns a frame's pose with the corrections of a spline in it."""
    if pose.frame_index is None:
        return pose
    given = body.rotations(pose.global_orient, pose.body_pose)
    rotations, transl = spline(pose.frame_index, given, pose.transl.to(given))
    quats = matrix_to_quaternion(rotations.double())
    quats = torch.where(quats[:, :1] < 0.0, -quats, quats)
    sine = quats[:, 1:].norm(dim=1, keepdim=True)
    angles = 2.0 * torch.atan2(sine, quats[:, :1])
    turns = (quats[:, 1:] * angles / sine.clamp(min=1e-12)).to(given)
    return Pose(pose.betas, turns[0], turns[1:].reshape(-1), transl, pose.frame_index)


class Aligner:
    """The search.

    Args:
        looks: at frames of one camera, in order of time.
        body: of their poses.
        every: frames from one knot to the next.
        registered: shift and scale of the pictures are known: cameras are corrected.
        frames: numbers of the frames of the sequence, where more than the looks are to be aligned.
    """

    def __init__(
        self,
        looks: Sequence[Look],
        body: Body,
        every: int,
        *,
        registered: bool = False,
        frames: Sequence[int] | None = None,
    ) -> None:
        frames = [look.index for look in looks] if frames is None else frames
        self._spline = PoseSpline.over(frames, every)
        self._looks, self._body, self._registered = looks, body, registered
        self._weights = np.stack([spline_weights(self._spline, look.index) for look in looks])
        self._knots = self._spline.knots
        rest = body.rest(looks[0].pose.betas).vertices.double().cpu().numpy()
        self._patch = _patches(rest)
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
        self.values = np.zeros((self._knots, POSE_COLUMNS))
        self.before = 0.0

    def run(self) -> Alignment | None:
        """Returns the alignment; None where outlines tell too little."""
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
        for _ in range(SETTLING if amount else 0):  # what is not taken need not be found to the end
            if not self._step(everyone, REACH, True):
                return None
        pixel = self._looks[0].pixel
        sides = np.array([pixel, pixel, 1.0])
        told = np.clip(1.0 - self._variance / self.spreads[self._group] ** 2, 0.0, 1.0)
        return Alignment(
            turns=amount * self.values[:, :72].reshape(-1, 24, 3),
            places=amount * self.values[:, 72:],
            spreads=dict(zip((*GROUPS, "place"), self.spreads.tolist(), strict=True)),
            amount=amount,
            gain=gain,
            told=told.reshape(self._knots, POSE_COLUMNS)[:, :72].reshape(-1, 24, 3),
            first=self._spline.first,
            spacing=self._spline.spacing,
            picture=picture * sides,
            picture_error=picture_error * sides,
            noise=self.noise * pixel,
            before=self.before * pixel,
        )

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
            amounts = [tuple(a * part for part in self.correction(k)) for a in AMOUNTS]
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
    ) -> bool:
        seen = self.observe(positions, reach, kept)
        if len(seen) < min(LEAST_FRAMES, len(positions)):
            return False
        system = OutlineSystem(seen, self._weights, self._patch, self.values, registered)
        if not self.before:
            self.before = 1.4826 * float(np.median(np.abs(system.offsets)))
        self._weigh(system)
        solution, variance = self._find_spreads(system)
        self.values = solution[: self._count].reshape(self._knots, POSE_COLUMNS)
        few = slice(self._count, self._count + 3)
        as_place = self.spreads[-1] * system.per_metre * np.array([1.0, 1.0, 1.0 / system.focal])
        self._picture = solution[few], np.sqrt(variance[few] + as_place**2)
        self._variance, self.noise = variance[: self._count], system.noise
        return True

    def observe(
        self, positions: Sequence[int], reach: float, kept: NDArray[np.bool_] | None = None
    ) -> list[tuple[int, Witness]]:
        """Returns what outlines say about the bodies as they are corrected so far, of frames that show any.

        Args:
            positions: of the frames.
            reach: as in `observe_outline`.
            kept: vertices whose points of an outline are taken, `[V]`; None: all.
        """
        each = max(1, len(positions) // LEAST_LOOKS)  # so that memory does not grow with the looks

        def witness_of(k: int) -> Witness | None:
            witness = observe_outline(self._body, self._looks[k], self.correction(k), reach)
            if witness is not None and each > 1:
                witness = witness.only(slice(None, None, each))
            return witness if witness is None or kept is None else witness.only(kept[witness.vertices])

        found = threaded_map(witness_of, positions, torch.get_num_threads())
        return [(k, witness) for k, witness in zip(positions, found, strict=True) if witness is not None]

    def _precision(self, system: OutlineSystem) -> Floats:
        return np.concatenate([self.spreads[self._group] ** -2.0, system.fixed_precision])

    def _weigh(self, system: OutlineSystem) -> None:
        """Weighs outlines by the residual about their fit."""
        for _ in range(2):
            system.weigh()
            system.settle(system.solve(self._precision(system)))
        system.weigh()

    def _find_spreads(self, system: OutlineSystem) -> tuple[Floats, Floats]:
        """Makes the spreads likelier; returns the unknowns and their variances."""
        for _ in range(EVIDENCE_STEPS):
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
    looks: Sequence[Look],
    body: Body,
    every: int,
    *,
    registered: bool = False,
    frames: Sequence[int] | None = None,
) -> Alignment | None:
    """Returns what outlines say of the poses of training frames; None where they tell too little.

    Args:
        looks: at training frames, in order of time; of a long sequence those of `positions_looked_at` are enough.
        body: of their poses.
        every: frames from one knot to the next.
        registered: shift and scale of the pictures are known: cameras are corrected.
        frames: numbers of all training frames; None: those that are looked at.
    """
    if len(looks) < LEAST_FRAMES:
        return None
    return Aligner(looks, body, every, registered=registered, frames=frames).run()


def positions_looked_at(count: int, every: int) -> list[int]:
    """Returns which of so many training frames are looked at: some of a long sequence, from its first to its last.

    Args:
        count: of the frames.
        every: frames from one knot to the next.
    """
    wanted = min(count, max(LEAST_LOOKS, LOOKS_A_KNOT * math.ceil(count / every)))
    return np.linspace(0, count - 1, wanted).round().astype(int).tolist()


def spline_weights(spline: PoseSpline, frame: float) -> Floats:
    """Returns how much each knot counts at a frame, `[K]`."""
    start, shares = spline.weights_at(frame)
    out = np.zeros(spline.knots)
    out[start : start + 4] = shares
    return out


def _patches(rest: Floats) -> Ints:
    """Returns the place of each vertex, `[V]`: places lie as far from each other as can be."""
    chosen, away = [0], np.linalg.norm(rest - rest[0], axis=1)
    while len(chosen) < min(PATCHES, len(rest)):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(rest - rest[chosen[-1]], axis=1))
    return np.asarray(cKDTree(rest[chosen]).query(rest)[1], np.int64)
