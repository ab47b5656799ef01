"""`skinning.bone_transforms` joint by joint, with the gradient written out.

Two dozen 3 x 3 matrices are nothing to a processor, and dozens of calls to torch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from occfusion.cpu.compilation import array_of, kernel

Array = NDArray[np.float32]
Parents = NDArray[np.int64]


class Kinematics(torch.autograd.Function):
    """Bone transforms `[J, 4, 4]` of rotations `[J, 3, 3]` and joints `[J, 3]`, for float32 on a CPU."""

    @staticmethod
    def forward(ctx: Any, rotations: Tensor, joints: Tensor, parents: tuple[int, ...]) -> Tensor:
        """Returns the transforms; sums are formed in float64."""
        count = len(joints)
        transforms, turns, places = torch.empty(count, 4, 4), np.empty((count, 3, 3)), np.empty((count, 3))
        ctx.tree, ctx.turns, ctx.places = np.array(parents), turns, places
        ctx.save_for_backward(rotations, joints)
        fill_bones(array_of(rotations), array_of(joints), ctx.tree, transforms.numpy(), turns, places)
        return transforms

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        """Returns the gradients by rotations and joints."""
        rotations, joints = ctx.saved_tensors
        to_rotations, to_joints = torch.empty(rotations.shape), torch.empty(joints.shape)
        _backward(
            array_of(rotations), array_of(joints), ctx.tree, ctx.turns, ctx.places, array_of(gradient),
            to_rotations.numpy(), to_joints.numpy(),
        )  # fmt: skip
        return to_rotations, to_joints, None


def warm_up() -> None:
    """Compiles the kernels, or loads them from the cache: by one joint."""
    turn = torch.eye(3)[None].requires_grad_()
    Kinematics.apply(turn, torch.zeros(1, 3), (-1,)).sum().backward()


@kernel
def fill_bones(
    rotations: NDArray[Any],
    joints: NDArray[Any],
    parents: Parents,
    transforms: NDArray[Any],
    turns: NDArray[np.float64],
    places: NDArray[np.float64],
) -> None:
    """Gives the motion of bones from rest to posed `[J, 4, 4]`, their turns `[J, 3, 3]` and where joints are `[J, 3]`.

    Of either precision; sums are formed in float64.
    """
    for m in range(len(parents)):
        above = parents[m]
        for i in range(3):
            if above < 0:
                places[m, i] = joints[m, i]
                for j in range(3):
                    turns[m, i, j] = rotations[m, i, j]
                continue
            total = places[above, i]
            for k in range(3):
                total += turns[above, i, k] * (np.float64(joints[m, k]) - joints[above, k])
            places[m, i] = total
            for j in range(3):
                total = 0.0
                for k in range(3):
                    total += turns[above, i, k] * rotations[m, k, j]
                turns[m, i, j] = total
        for i in range(3):
            total = places[m, i]
            for j in range(3):
                transforms[m, i, j] = turns[m, i, j]
                total -= turns[m, i, j] * joints[m, j]
            # where a joint is at rest goes to where it is posed
            transforms[m, i, 3] = total
            transforms[m, 3, i] = 0.0
        transforms[m, 3, 3] = 1.0


@kernel
def _backward(
    rotations: Array,
    joints: Array,
    parents: Parents,
    turns: NDArray[np.float64],
    places: NDArray[np.float64],
    gradient: Array,
    to_rotations: Array,
    to_joints: Array,
) -> None:
    count = len(parents)
    to_turns, to_places = np.zeros((count, 3, 3)), np.zeros((count, 3))
    own = np.zeros((count, 3))
    for m in range(count):
        for i in range(3):
            shift = np.float64(gradient[m, i, 3])
            to_places[m, i] += shift
            for j in range(3):
                to_turns[m, i, j] += gradient[m, i, j] - shift * joints[m, j]
                own[m, j] -= turns[m, i, j] * shift
    # children stand after their parents: what reaches a joint from below is whole when its turn comes
    for m in range(count - 1, -1, -1):
        above = parents[m]
        if above < 0:
            for i in range(3):
                own[m, i] += to_places[m, i]
                for j in range(3):
                    to_rotations[m, i, j] = to_turns[m, i, j]
            continue
        for k in range(3):
            offset = np.float64(joints[m, k]) - joints[above, k]
            pulled = 0.0
            for i in range(3):
                pulled += turns[above, i, k] * to_places[m, i]
                to_turns[above, i, k] += to_places[m, i] * offset
            own[m, k] += pulled
            own[above, k] -= pulled
            for j in range(3):
                total = 0.0
                for i in range(3):
                    total += turns[above, i, k] * to_turns[m, i, j]
                    to_turns[above, i, k] += to_turns[m, i, j] * rotations[m, k, j]
                to_rotations[m, k, j] = total
        for i in range(3):
            to_places[above, i] += to_places[m, i]
    for m in range(count):
        for j in range(3):
            to_joints[m, j] = own[m, j]
