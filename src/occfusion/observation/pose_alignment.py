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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri
from scipy.spatial import cKDTree

from occfusion.geometry.rotation import matrix_to_quaternion
from occfusion.human.body import Body
from occfusion.human.pose_spline import PoseSpline
from occfusion.observation.pose_witness import POSE_COLUMNS, REACH, Look, Witness, observe_outline
from occfusion.types import Pose

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

PATCHES = 300
STANDS_OFF, MEAN_STANDS_OFF = 0.015, 0.02
"""Metres: of a place of the body, and of all of it."""
SHAPE = 0.5
"""Standard deviations of the shape."""
SHIFT, SCALE = 0.01, 0.02
"""Of the person's size, and of the focal length: by how much the pictures lie off the cameras."""
GROUPS: dict[str, tuple[int, ...]] = {
    "root": (0,), "trunk": (3, 6, 9, 12, 13, 14), "head": (15,), "hips": (1, 2), "knees": (4, 5),
    "feet": (7, 8, 10, 11), "shoulders": (16, 17), "elbows": (18, 19), "hands": (20, 21, 22, 23),
}  # fmt: skip
"""Joints whose errors are alike: each group has one spread, the place another."""
FIRST_TURN, FIRST_PLACE = 0.03, 0.01
"""Radians and metres: spreads that the search begins with."""
LEAST_TURN, LEAST_PLACE = 1e-4, 1e-4
"""Spreads below which nothing is told from nothing."""
NOISE = 0.2
"""Pixels, at least: the staircase of a binary mask."""
CORRELATED = 3.0
"""Neighbouring pixels of an outline err alike: at least so many count as one."""
BIWEIGHT = 4.7
ROUNDS, SETTLING, EVIDENCE_STEPS = 3, 2, 2
"""Looks at outlines with shift and scale of the pictures unknown, then without; estimates of the spreads in each."""
CERTAIN = 5.0
"""Standard deviations from which on pictures are certainly shifted or scaled, as in `data.registration`."""
FULL_TURN, FULL_PLACE = 0.02, 0.01
"""Radians and metres: spreads from which on training may move poses as fast as its rates say."""
MOST_KNOTS = 60
LEAST_FRAMES = 10


@dataclass(frozen=True)
class Alignment:
    """What outlines say of the poses of a sequence.

    Attributes:
        turns: of the spline's knots, `[K, 24, 3]`, radians.
        places: `[K, 3]`, metres.
        spreads: standard deviation of what each group of joints, and the place, is off: radians, metres.
        told: share of each turn that outlines tell, `[K, 24, 3]`, 0 to 1.
        first: of the spline.
        spacing: of the spline.
        picture: shift in x and y, pixels, and scale less 1, that the pictures have beside the cameras, `[3]`.
        picture_error: standard deviations of `picture`; a body that is misplaced throughout by as much as it wanders
            explains it as well, and that is part of them.
        noise: of outlines about the fit, pixels.
        before: of outlines about the poses as given, pixels.
    """

    turns: Floats
    places: Floats
    spreads: dict[str, float]
    told: Floats
    first: float
    spacing: float
    picture: Floats
    picture_error: Floats
    noise: float
    before: float

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
        reach = self.told * np.minimum(1.0, spreads[group] / FULL_TURN)[:, None]
        place = np.full(self.places.shape, min(1.0, spreads[-1] / FULL_PLACE))
        made.start_at(*(torch.from_numpy(part).float() for part in (self.turns, self.places, reach, place)))
        return made

    def text(self) -> str:
        """Returns what was found, in words."""
        turns = [value for name, value in self.spreads.items() if name != "place"]
        return (
            f"outlines lie {self.before:.2f} px off the poses as given and {self.noise:.2f} px off the aligned ones; "
            f"joints are off by {np.degrees(np.median(turns)):.1f} degrees, the place by "
            f"{1000 * self.spreads['place']:.0f} mm"
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
    """

    def __init__(self, looks: Sequence[Look], body: Body, every: int, *, registered: bool = False) -> None:
        self._looks, self._body, self._registered = looks, body, registered
        numbers = [look.index for look in looks]
        every = max(every, -(-len(looks) // MOST_KNOTS))
        self._spline = PoseSpline.over(numbers, every)
        self._weights = np.stack([spline_weights(self._spline, n) for n in numbers])
        self._knots = self._spline.knots
        rest = body.rest(looks[0].pose.betas).vertices.double().cpu().numpy()
        self._patch = _patches(rest)
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
        picture, picture_error = np.zeros(3), np.ones(3)
        for number in range(ROUNDS + SETTLING):
            settling = self._registered or number >= ROUNDS
            if not self._step(2.0 * REACH if number == 0 else REACH, None if settling else SHIFT):
                return None
            if not settling:
                picture, picture_error = self._picture
        told = np.clip(1.0 - self._variance / self.spreads[self._group] ** 2, 0.0, 1.0)
        return Alignment(
            turns=self.values[:, :72].reshape(-1, 24, 3),
            places=self.values[:, 72:],
            spreads=dict(zip((*GROUPS, "place"), self.spreads.tolist(), strict=True)),
            told=told.reshape(self._knots, POSE_COLUMNS)[:, :72].reshape(-1, 24, 3),
            first=self._spline.first,
            spacing=self._spline.spacing,
            picture=picture,
            picture_error=picture_error,
            noise=self.noise,
            before=self.before,
        )

    def correction(self, position: int) -> tuple[Floats, Floats]:
        """Returns turns `[24, 3]` and shift `[3]` of a frame by its position."""
        value = self._weights[position] @ self.values
        return value[:72].reshape(24, 3), value[72:]

    def _step(self, reach: float, shift: float | None) -> bool:
        found = [
            observe_outline(self._body, look, self.correction(k), reach) for k, look in enumerate(self._looks)
        ]
        seen = [(k, witness) for k, witness in enumerate(found) if witness is not None]
        if len(seen) < LEAST_FRAMES:
            return False
        system = _System(seen, self._weights, self._patch, self.values, shift)
        if not self.before:
            self.before = 1.4826 * float(np.median(np.abs(system.offsets)))
        precision = np.concatenate([self.spreads[self._group] ** -2.0, system.fixed_precision])
        for _ in range(2):  # weights, from the residual about the last fit
            system.weigh()
            system.settle(system.solve(precision)[0])
        system.weigh()
        for _ in range(EVIDENCE_STEPS):
            precision[: self._count] = self.spreads[self._group] ** -2.0
            solution, variance = system.solve(precision)
            self._update_spreads(solution[: self._count], variance[: self._count])
        self.values = solution[: self._count].reshape(self._knots, POSE_COLUMNS)
        few = slice(self._count, self._count + 3)
        as_place = self.spreads[-1] * system.per_metre * np.array([1.0, 1.0, 1.0 / system.focal])
        self._picture = solution[few], np.sqrt(variance[few] + as_place**2)
        self._variance, self.noise = variance[: self._count], system.noise
        return True

    def _update_spreads(self, values: Floats, variance: Floats) -> None:
        """Gives each group the spread that makes what is seen most likely, one step of MacKay's."""
        for number in range(len(self.spreads)):
            own = self._group == number
            told = float((1.0 - variance[own] / self.spreads[number] ** 2).clip(0.0, 1.0).sum())
            spread = np.sqrt(float((values[own] ** 2).sum()) / max(told, 1e-3))
            least = LEAST_PLACE if number == len(GROUPS) else LEAST_TURN
            # a step of MacKay's may leap: by a factor of four at most
            self.spreads[number] = max(
                least, np.clip(spread, 0.25 * self.spreads[number], 4.0 * self.spreads[number])
            )


class _System:
    """All outlines of the sequence as one linear system of knots and of what is alike in all frames."""

    def __init__(
        self,
        seen: Sequence[tuple[int, Witness]],
        weights: Floats,
        patch: Ints,
        values: Floats,
        shift: float | None,
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
        spread = np.array([1e-6, 1e-6, 1e-6] if shift is None else [shift * size, shift * size, SCALE])
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
            self._targets[self._ends[n] : self._ends[n + 1]] += w.turns @ (weights[k] @ values)
        self._residual = self.offsets - np.median(self.offsets)
        self.noise = NOISE
        self.row_weights = np.ones(len(self.offsets))

    def weigh(self) -> None:
        """Weighs rows by how well they fit (Tukey's biweight), and by how alike neighbours' errors are."""
        self.noise = max(1.4826 * float(np.median(np.abs(self._residual))), NOISE)
        weights = np.clip(1.0 - (self._residual / (BIWEIGHT * self.noise)) ** 2, 0.0, None) ** 2
        self.row_weights = weights / (self._alike(weights) * self.noise**2)
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
            parts.append(w.turns @ (self._spline_weights[k] @ values) + self._rows(w) @ extra)
        return np.concatenate(parts)

    def _rows(self, w: Witness) -> Floats:
        rows = np.zeros((len(w.offsets), self._extra))
        few = np.column_stack([w.picture, w.shape, w.per_metre])
        rows[:, : few.shape[1]] = few
        rows[np.arange(len(rows)), few.shape[1] + self._patch[w.vertices]] = w.per_metre
        return rows

    def _assemble(self) -> None:
        total = self.count + self._extra
        normal, right = np.zeros((total, total)), np.zeros(total)
        size = POSE_COLUMNS
        for n, (k, w) in enumerate(self._seen):
            own = slice(self._ends[n], self._ends[n + 1])
            rows = np.concatenate([w.turns, self._rows(w)], axis=1)
            weighted = rows * self.row_weights[own, None]
            block, part = weighted.T @ rows, weighted.T @ self._targets[own]
            active = np.flatnonzero(self._spline_weights[k])
            for a in active:
                wa, sa = self._spline_weights[k, a], slice(a * size, (a + 1) * size)
                right[sa] += wa * part[:size]
                normal[sa, self.count :] += wa * block[:size, size:]
                for b in active:
                    normal[sa, b * size : (b + 1) * size] += (
                        wa * self._spline_weights[k, b] * block[:size, :size]
                    )
            normal[self.count :, self.count :] += block[size:, size:]
            right[self.count :] += part[size:]
        normal[self.count :, : self.count] = normal[: self.count, self.count :].T
        self._normal, self._right = normal, right

    def solve(self, precision: Floats) -> tuple[Floats, Floats]:
        """Returns the most likely unknowns, and their variances."""
        # in units of the prior's spread the system is well scaled whatever it is
        scale = precision**-0.5
        scaled = self._normal * scale[:, None] * scale
        scaled[np.diag_indices_from(scaled)] += 1.0
        factor = cho_factor(scaled, lower=True, overwrite_a=True)
        solution = scale * cho_solve(factor, scale * self._right)
        inverse, _ = dpotri(factor[0], lower=1, overwrite_c=1)
        return solution, scale**2 * np.diag(inverse)


def align_poses(
    looks: Sequence[Look], body: Body, every: int, *, registered: bool = False
) -> Alignment | None:
    """Returns what outlines say of the poses of training frames; None where they tell too little.

    Args:
        looks: at the training frames, in order of time.
        body: of their poses.
        every: frames from one knot to the next; more where the sequence is long.
        registered: shift and scale of the pictures are known: cameras are corrected.
    """
    if len(looks) < LEAST_FRAMES:
        return None
    return Aligner(looks, body, every, registered=registered).run()


def spline_weights(spline: PoseSpline, frame: float) -> Floats:
    """Returns how much each knot counts at a frame, `[K]`."""
    place = (frame - spline.first) / spline.spacing
    start = min(int(place), spline.knots - 4)
    u, out = place - start, np.zeros(spline.knots)
    out[start : start + 4] = (
        np.array([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, 1 + 3 * u + 3 * u**2 - 3 * u**3, u**3]) / 6
    )
    return out


def _patches(rest: Floats) -> Ints:
    """Returns the place of each vertex, `[V]`: places lie as far from each other as can be."""
    chosen, away = [0], np.linalg.norm(rest - rest[0], axis=1)
    while len(chosen) < min(PATCHES, len(rest)):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(rest - rest[chosen[-1]], axis=1))
    return np.asarray(cKDTree(rest[chosen]).query(rest)[1], np.int64)
