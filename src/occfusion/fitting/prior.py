"""What poses a body takes: how far joints bend, and how likely a pose is, learned from the embedded motions."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor

from occfusion.synth.motion import make_take

SEEDS = 12
"""Takes of the motions that the prior is learned from; those kept for evaluation are not among them."""
LOOSE = 0.25
"""Standard deviation, in radians, added to that of the motions: people do more than two recordings."""

LIMITS: dict[int, tuple[tuple[float, float], ...]] = {
    1: ((-2.3, 0.7), (-0.9, 0.9), (-0.8, 1.0)),
    2: ((-2.3, 0.7), (-0.9, 0.9), (-1.0, 0.8)),
    4: ((-0.05, 2.6), (-0.35, 0.35), (-0.2, 0.2)),
    5: ((-0.05, 2.6), (-0.35, 0.35), (-0.2, 0.2)),
    7: ((-0.9, 0.7), (-0.4, 0.4), (-0.4, 0.4)),
    8: ((-0.9, 0.7), (-0.4, 0.4), (-0.4, 0.4)),
    10: ((-0.1, 0.1),) * 3,
    11: ((-0.1, 0.1),) * 3,
    3: ((-0.4, 0.7), (-0.5, 0.5), (-0.4, 0.4)),
    6: ((-0.3, 0.6), (-0.5, 0.5), (-0.4, 0.4)),
    9: ((-0.3, 0.4), (-0.4, 0.4), (-0.3, 0.3)),
    12: ((-0.6, 0.6), (-0.8, 0.8), (-0.5, 0.5)),
    15: ((-0.6, 0.6), (-0.8, 0.8), (-0.5, 0.5)),
    13: ((-0.3, 0.3), (-0.5, 0.4), (-0.3, 0.6)),
    14: ((-0.3, 0.3), (-0.4, 0.5), (-0.6, 0.3)),
    18: ((-1.4, 1.4), (-2.6, 0.1), (-1.0, 1.0)),
    19: ((-1.4, 1.4), (-0.1, 2.6), (-1.0, 1.0)),
    20: ((-0.6, 0.6), (-0.7, 0.7), (-0.9, 0.9)),
    21: ((-0.6, 0.6), (-0.7, 0.7), (-0.9, 0.9)),
    22: ((-0.1, 0.1),) * 3,
    23: ((-0.1, 0.1),) * 3,
}
"""Range of each joint's axis-angle about x, y, z, radians, in the body's rest pose with arms spread.

Hips bend by -x, knees by +x, the left elbow by -y, the right by +y. Shoulders go everywhere."""


@cache
def _learned() -> tuple[Tensor, Tensor]:
    """Returns mean `[69]` and precision `[69, 69]` of body poses, left and right alike."""
    rows = []
    for seed in range(SEEDS):
        rng = np.random.default_rng([seed, 5])
        rows.append(make_take(200, np.zeros(10), False, rng).poses[:, 3:])
    poses = np.concatenate(rows)
    both = np.concatenate([poses, mirrored(poses)])
    covariance = np.cov(both.T) + LOOSE**2 * np.eye(69)
    return (
        torch.tensor(both.mean(axis=0), dtype=torch.float32),
        torch.tensor(np.linalg.inv(covariance), dtype=torch.float32),
    )


_SIDES = [1, 0, 2, 4, 3, 5, 7, 6, 8, 10, 9, 11, 13, 12, 14, 16, 15, 18, 17, 20, 19, 22, 21]
"""Of each of the joints 1 to 23, from 0, the one on the other side."""


def mirrored(poses: np.ndarray) -> np.ndarray:
    """Returns body poses `[N, 69]` of the mirrored person: sides exchanged, turns about y and z reversed."""
    joints = poses.reshape(len(poses), 23, 3)[:, _SIDES] * np.array([1.0, -1.0, -1.0])
    return np.asarray(joints.reshape(len(poses), 69))


def mean_pose() -> Tensor:
    """Returns the mean body pose, `[69]`."""
    return _learned()[0]


def unlikely(body_pose: Tensor) -> Tensor:
    """Returns half the squared Mahalanobis distance of poses `[N, 69]` from the learned ones, `[N]`."""
    mean, precision = _learned()
    apart = body_pose - mean
    return 0.5 * ((apart @ precision) * apart).sum(dim=-1)


@cache
def _bounds() -> tuple[Tensor, Tensor]:
    low, high = torch.full((23, 3), -9.0), torch.full((23, 3), 9.0)
    for joint, axes in LIMITS.items():
        for axis, (least, most) in enumerate(axes):
            low[joint - 1, axis], high[joint - 1, axis] = least, most
    return low.reshape(69), high.reshape(69)


def beyond_limits(body_pose: Tensor) -> Tensor:
    """Returns the squared excess over the joints' limits of poses `[N, 69]`, radians squared, `[N]`."""
    low, high = _bounds()
    return ((low - body_pose).clamp(min=0) ** 2 + (body_pose - high).clamp(min=0) ** 2).sum(dim=-1)
