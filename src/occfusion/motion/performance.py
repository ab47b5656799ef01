"""A clip as one body performs it: own size, on a floor; and the upright frame that cameras go round in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor

from occfusion.geometry.skinning import blend, bone_transforms, posed_joints, skin_points
from occfusion.human import Body
from occfusion.motion.clip import Array, Clip
from occfusion.types import Pose

FLOOR_SECONDS = 2.0
"""Where a clip of somebody else floats or sinks for longer, it is put back on the floor; jumps are shorter."""
_FOOT_JOINTS = (7, 8, 10, 11)
_LEG = ((1, 4), (4, 7))
_UNKNOWN_RATE = 30.0
"""Frames a second that windows of time go by where nobody says."""
_REACH = 4.0
"""Standard deviations at which the bell is cut off that series are smoothed by."""


@dataclass(frozen=True)
class Performance:
    """Poses of one body over time, and how its world lies to an upright one.

    Attributes:
        clip: what is performed; translations are those of this body.
        betas: of the body, `[B]`.
        upright: from the clip's world to the upright frame, rigid `[4, 4]`: +y is up, the floor is y = 0, the first
            frame stands over the origin and faces +z.
        roots: places of the pelvis in the upright frame, `[T, 3]`, metres.
        low: lower corner of all joints, around the pelvis' place on the floor, `[3]`, metres, upright frame.
        high: upper corner, `[3]`.
    """

    clip: Clip
    betas: Tensor
    upright: Tensor
    roots: Array
    low: Array
    high: Array

    def __len__(self) -> int:
        """Returns the number of frames."""
        return len(self.clip)

    def pose(self, row: int) -> Pose:
        """Returns the pose of a frame, in the clip's own world."""
        clip = self.clip
        orient, body, transl = (
            torch.tensor(part[row]).float() for part in (clip.global_orient, clip.body_pose, clip.transl)
        )
        number = None if clip.numbers is None else float(clip.numbers[row])
        return Pose(self.betas, orient, body, transl, number)

    @cached_property
    def paths(self) -> Array:
        """Places that a camera follows, `[T, 3]`, upright frame: on the floor below the pelvis, smooth."""
        over_floor = self.roots * (1.0, 0.0, 1.0)
        rate = self.clip.fps or _UNKNOWN_RATE
        return smoothed(over_floor, 0.5 * rate)


@torch.no_grad()
def perform(clip: Clip, body: Body, betas: Tensor, legs: float | None = None) -> Performance:
    """Returns a clip as a body performs it.

    A clip of the sequence that the avatar learned from is taken as it is. Any other moves the body's own bones: its
    way over the floor is as long as the legs are beside those of whoever moved, where those are known, and its height
    is such that the lowest foot touches the floor once within every `FLOOR_SECONDS`.

    Args:
        clip: the motion.
        body: of the avatar.
        betas: shape of the avatar, `[B]`.
        legs: length of the mover's legs, metres; None where it is not known.
    """
    up = clip.up_direction
    transl = clip.transl.copy()
    rest = body.rest(betas)
    if clip.numbers is None and legs is not None:
        transl *= leg_length(rest.joints) / legs
    feet, joints = _placed(clip, body, betas)
    lowest = (feet @ up).min(axis=1) + transl @ up
    if clip.numbers is None:
        floor = _floor(lowest, clip.fps or _UNKNOWN_RATE)
        transl -= floor[:, None] * up
        lowest = lowest - floor
    joints = joints + transl[:, None]
    upright = _upright(joints[0], up, float(lowest.min()))
    seen = joints @ upright[:3, :3].T + upright[:3, 3]
    roots = seen[:, 0]
    beside = seen - roots[:, None] * (1.0, 0.0, 1.0)
    low, high = beside.min(axis=(0, 1)), beside.max(axis=(0, 1))
    moved = replace(clip, transl=transl)
    return Performance(moved, betas, torch.from_numpy(upright).float(), roots, low, high)


def at_rest(low: Array, high: Array) -> Performance:
    """Returns the performance that stands still in a world that is upright already, for what has no motion.

    Args:
        low: lower corner of what is shown, `[3]`, metres; +y is up.
        high: upper corner, `[3]`.
    """
    clip = Clip("canonical", np.zeros((1, 3)), np.zeros((1, 69)), np.zeros((1, 3)), None, "y")
    return Performance(clip, torch.zeros(0), torch.eye(4), np.zeros((1, 3)), low, high)


def leg_length(joints: Tensor) -> float:
    """Returns the length of thigh and shin, metres, of joints at rest `[24, 3]`."""
    return float(sum((joints[b] - joints[a]).norm() for a, b in _LEG))


def _placed(clip: Clip, body: Body, betas: Tensor) -> tuple[Array, Array]:
    """Returns the vertices of the feet `[T, F, 3]` and the joints `[T, 24, 3]`, before the translation."""
    rest = body.rest(betas)
    of_feet = body.weights[:, list(_FOOT_JOINTS)].sum(dim=1) > 0.5
    if not bool(of_feet.any()):  # a body of few vertices: its joints stand for it
        of_feet = torch.ones_like(of_feet)
    points, maps = rest.vertices[of_feet][::4], body.weights[of_feet][::4]
    feet, joints = [], []
    for turn, pose in zip(clip.global_orient, clip.body_pose, strict=True):
        rotations = body.rotations(torch.tensor(turn), torch.tensor(pose)).to(rest.joints)
        transforms = bone_transforms(rotations, rest.joints, body.parents)
        feet.append(skin_points(points, blend(maps, transforms)).numpy())
        joints.append(posed_joints(transforms, rest.joints).numpy())
    return np.asarray(feet, np.float64), np.asarray(joints, np.float64)


def _floor(lowest: Array, fps: float) -> Array:
    """Returns the height of the floor at each frame, `[T]`: the least within a window of time, smoothed."""
    window = max(round(FLOOR_SECONDS * fps), 1)
    return smoothed(least_nearby(lowest, window), window / 4)


def smoothed(series: Array, deviation: float) -> Array:
    """Returns a series under a Gaussian bell; beyond its ends it is taken to be as at its ends.

    Args:
        series: `[T, ...]`.
        deviation: of the bell, steps.
    """
    radius = int(_REACH * deviation + 0.5)
    bell = np.exp(-0.5 * (np.arange(-radius, radius + 1) / deviation) ** 2) if radius else np.ones(1)
    return np.asarray(_windows(series, radius, radius) @ (bell / bell.sum()))


def least_nearby(series: Array, window: int) -> Array:
    """Returns the least value within a window around each step.

    Args:
        series: `[T, ...]`.
        window: steps; of an even number there is one more before than after.
    """
    before = window // 2
    return np.asarray(_windows(series, before, window - 1 - before).min(axis=-1))


def _windows(series: Array, before: int, after: int) -> Array:
    """Returns what is around each step, `[T, ..., before + 1 + after]`."""
    beyond = [(before, after), *[(0, 0)] * (series.ndim - 1)]
    return sliding_window_view(np.pad(series, beyond, mode="edge"), before + 1 + after, axis=0)


def _upright(joints: Array, up: Array, floor: float) -> Array:
    """Returns the rigid map to the upright frame from the first frame's joints `[24, 3]`."""
    across = joints[1] - joints[2]  # from the right hip to the left one
    across = across - up * (across @ up)
    if np.linalg.norm(across) < 1e-3:  # lying on a side: any heading will do
        across = np.roll(up, 1)
    across /= np.linalg.norm(across)
    rotation = np.stack([across, up, np.cross(across, up)])
    out = np.eye(4)
    out[:3, :3] = rotation
    foot = rotation @ joints[0]
    out[:3, 3] = (-foot[0], -floor, -foot[2])
    return out


def spread_rows(count: int, rows: int) -> Sequence[int]:
    """Returns which of `rows` frames each of `count` pictures shows, first to last."""
    return [min(math.floor(k * rows / count), rows - 1) for k in range(count)]
