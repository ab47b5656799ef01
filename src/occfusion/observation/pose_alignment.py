"""What outlines of masks say of the poses of a sequence, and poses with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.geometry.rotation import matrix_to_quaternion
from occfusion.human.body import Body
from occfusion.human.pose_spline import PoseSpline
from occfusion.types import Pose

Floats = NDArray[np.float64]

GROUPS: dict[str, tuple[int, ...]] = {
    "root": (0,), "trunk": (3, 6, 9, 12, 13, 14), "head": (15,), "hips": (1, 2), "knees": (4, 5),
    "feet": (7, 8, 10, 11), "shoulders": (16, 17), "elbows": (18, 19), "hands": (20, 21, 22, 23),
}  # fmt: skip
"""Joints whose errors are alike: each group has one spread, the place another."""
CERTAIN = 5.0
"""Standard deviations from which on pictures are certainly shifted or scaled, as in `data.registration`."""
FULL_TURN, FULL_PLACE = 0.02, 0.01
"""Radians and metres: spreads from which on training may move poses as fast as its rates say."""
WORTH = 0.06
"""Of the misfit with masks there, the share that has to go before anything is taken: exact poses gain nothing, or 5 %
where mask edges wander by pixels; those off by 0.01 radians gain 10 and more
(docs/experiments/074-fewer-points-better-poses.md)."""


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
