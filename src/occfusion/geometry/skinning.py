"""Forward kinematics of a joint tree and linear blend skinning of points and covariances (paper §3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def bone_transforms(
    rotations: Tensor, joints: Tensor, parents: Sequence[int], *, compiled: bool = False
) -> Tensor:
    """Returns the rigid motion of each joint's bone from rest to posed: the paper's `G_k` and `b_k`.

    The gradient is written out, since 24 joints are hundreds of tiny steps to autograd; it takes for granted
    that `rotations` are rotations, whose transpose is their inverse.

    Args:
        rotations: rotation of each joint relative to its parent, `[J, 3, 3]`.
        joints: joint positions at rest, `[J, 3]`, metres.
        parents: parent of each joint; -1 for the root, else smaller than the joint's own index.
        compiled: by the kernels of `skinning_kernels.py`, of which this is the specification, where they take the
            joints: float32. Those of a GPU come to the host and go back: 24 joints for a hundred launches each way.

    Returns:
        `[J, 4, 4]`; joint 0 of a pose that only turns the root moves points about that joint.
    """
    known = tuple(int(parent) for parent in parents)
    if compiled and rotations.dtype == torch.float32 and rotations.device.type in ("cpu", "cuda"):
        _tree(known)  # refuses what is no tree
        # numba is loaded where it is used
        from occfusion.geometry import skinning_kernels

        transforms: Tensor = skinning_kernels.Kinematics.apply(rotations.cpu(), joints.cpu(), known)
        return transforms.to(rotations.device)
    return _Kinematics.apply(rotations, joints, known)


def posed_joints(transforms: Tensor, joints: Tensor) -> Tensor:
    """Returns the posed joint positions `[J, 3]` from `bone_transforms` and the joints at rest `[J, 3]`."""
    return _turned(transforms[:, :3, :3], joints) + transforms[:, :3, 3]


def blend(weights: Tensor, transforms: Tensor) -> Tensor:
    """Returns each point's blended affine map `[N, 3, 4]`: one matrix product, no `[N, J, 4, 4]` in between.

    Args:
        weights: skinning weights, `[N, J]`, rows sum to 1.
        transforms: bone transforms, `[J, 4, 4]`.
    """
    return (weights @ transforms[:, :3].flatten(1)).unflatten(1, (3, 4))


def skin_points(points: Tensor, maps: Tensor) -> Tensor:
    """Returns points `[N, 3]` moved by affine maps `[N, 3, 4]`."""
    return torch.baddbmm(maps[:, :, 3:], maps[:, :, :3], points.unsqueeze(-1)).squeeze(-1)


def skin_covariances(covariances: Tensor, maps: Tensor) -> Tensor:
    """Returns covariances `[N, 3, 3]` carried by affine maps `[N, 3, 4]`: T S T^t with the linear part T.

    Nothing is inverted, so a blend of opposite twists, whose linear part is singular, only flattens the
    Gaussian.
    """
    linear = maps[:, :, :3]
    return linear @ covariances @ linear.transpose(1, 2)


def invert_affine(maps: Tensor) -> Tensor:
    """Returns the inverse affine maps `[N, 3, 4]` in closed form (adjugate over determinant).

    Only for maps known to be regular, such as blends of the Da pose (see `human.body`): the inverse of a
    general blend of bone transforms may not exist.
    """
    a, b, c = maps[:, :, 0], maps[:, :, 1], maps[:, :, 2]
    rows = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=1)
    determinant = (a * rows[:, 0]).sum(-1)
    linear = rows / determinant[:, None, None]
    return torch.cat([linear, -(linear @ maps[:, :, 3:])], dim=-1)


class _Kinematics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rotations: Tensor, joints: Tensor, parents: tuple[int, ...]) -> Tensor:
        tree = _tree(parents)
        above = joints[tree.parents].masked_fill(_first(joints, 1), 0.0)
        local = _rigid(rotations, joints - above)
        levels = [local[:1]]
        for level in tree.levels:
            levels.append(levels[-1][level.parent_slots] @ local[level.joints])
        world = torch.cat(levels)[tree.order]
        turns, places = world[:, :3, :3], world[:, :3, 3]
        ctx.save_for_backward(joints, turns, places)
        ctx.tree = tree
        # where a joint is at rest goes to where it is posed
        return _rigid(turns, places - _turned(turns, joints))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        joints, turns, places = ctx.saved_tensors
        tree: _Tree = ctx.tree
        to_places = gradient[:, :3, 3]
        to_turns = gradient[:, :3, :3] - to_places.unsqueeze(-1) * joints.unsqueeze(1)
        # turning joint m carries all below it as one rigid body: R_k = R_m D, p_k = p_m + R_m d with D and d
        # fixed
        below = tree.below.to(joints)
        moments = to_turns @ turns.transpose(1, 2) + to_places.unsqueeze(-1) * places.unsqueeze(1)
        pull = below @ to_places
        total = (below @ moments.flatten(1)).unflatten(1, (3, 3)) - pull.unsqueeze(-1) * places.unsqueeze(1)
        identity = torch.eye(3, dtype=joints.dtype, device=joints.device)
        above = torch.where(_first(joints, 2), identity, turns[tree.parents])
        to_rotations = above.transpose(1, 2) @ total @ turns
        to_offsets = _turned(above.transpose(1, 2), pull)
        to_joints = to_offsets - _turned(turns.transpose(1, 2), to_places)
        upwards = torch.tensor(tree.parents[1:], dtype=torch.int64, device=joints.device)
        return to_rotations, to_joints.index_add(0, upwards, -to_offsets[1:]), None


class _Level(NamedTuple):
    """Joints of one depth, and the places of their parents among those of the depth before."""

    joints: list[int]
    parent_slots: list[int]


class _Tree(NamedTuple):
    """A joint tree, level by level below the root.

    `parents` has 0 for the root; `order` says where each joint stands in the levels one after another;
    `below[m][k]` is 1 where joint k is m or below it.
    """

    levels: tuple[_Level, ...]
    parents: list[int]
    order: list[int]
    below: Tensor


@lru_cache(maxsize=16)
def _tree(parents: tuple[int, ...]) -> _Tree:
    if not parents or parents[0] != -1 or any(not 0 <= p < k for k, p in enumerate(parents) if k):
        raise ValueError(f"parents {parents}: the first must be -1, the others must precede their children")
    count = len(parents)
    ancestors: list[list[int]] = []
    for joint, parent in enumerate(parents):
        ancestors.append([*(ancestors[parent] if joint else []), joint])
    depths = [[j for j in range(count) if len(ancestors[j]) == d] for d in range(1, count + 1)]
    depths = [joints for joints in depths if joints]
    levels = [_Level(here, [above.index(parents[j]) for j in here]) for above, here in pairwise(depths)]
    listed = [joint for joints in depths for joint in joints]
    below = torch.tensor([[float(m in ancestors[k]) for k in range(count)] for m in range(count)])
    return _Tree(tuple(levels), [0, *parents[1:]], [listed.index(j) for j in range(count)], below)


def _first(joints: Tensor, trailing: int) -> Tensor:
    """Returns bool `[J, 1, ...]`, true for the root."""
    flags = torch.zeros(len(joints), *[1] * trailing, dtype=torch.bool, device=joints.device)
    flags[0] = True
    return flags


def _turned(rotations: Tensor, vectors: Tensor) -> Tensor:
    return (rotations @ vectors.unsqueeze(-1)).squeeze(-1)


def _rigid(rotations: Tensor, translations: Tensor) -> Tensor:
    top = torch.cat([rotations, translations.unsqueeze(-1)], dim=-1)
    bottom = torch.zeros_like(top[:, :1])
    bottom[:, :, 3] = 1.0
    return torch.cat([top, bottom], dim=1)
