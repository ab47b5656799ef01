"""Forward kinematics of a joint tree and linear blend skinning of points and covariances (paper §3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import torch
from torch import Tensor


def bone_transforms(rotations: Tensor, joints: Tensor, parents: Sequence[int]) -> Tensor:
    """Returns the rigid motion of each joint's bone from rest to posed: the paper's `G_k` and `b_k`.

    Joints of the same depth are handled together, so the cost follows the depth of the tree (9 for SMPL).

    Args:
        rotations: rotation of each joint relative to its parent, `[J, 3, 3]`.
        joints: joint positions at rest, `[J, 3]`, metres.
        parents: parent of each joint; -1 for the root, else smaller than the joint's own index.

    Returns:
        `[J, 4, 4]`; joint 0 of a pose that only turns the root moves points about that joint.
    """
    tree = _levels(tuple(int(parent) for parent in parents))
    local = _rigid(rotations, joints - _parent_joints(joints, tree))
    levels = [local[tree[0].joints]]
    for level in tree[1:]:
        levels.append(levels[-1][level.parent_slots] @ local[level.joints])
    world = torch.cat(levels)[_order(tree)]
    # where a joint is at rest goes to where it is posed
    shift = world[:, :3, 3] - (world[:, :3, :3] @ joints.unsqueeze(-1)).squeeze(-1)
    return _rigid(world[:, :3, :3], shift)


def posed_joints(transforms: Tensor, joints: Tensor) -> Tensor:
    """Returns the posed joint positions `[J, 3]` from `bone_transforms` and the joints at rest `[J, 3]`."""
    return (transforms[:, :3, :3] @ joints.unsqueeze(-1)).squeeze(-1) + transforms[:, :3, 3]


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


class _Level:
    """Joints of one depth, and the places of their parents among those of the depth before."""

    def __init__(self, joints: list[int], parent_slots: list[int]) -> None:
        self.joints = joints
        self.parent_slots = parent_slots


@lru_cache(maxsize=16)
def _levels(parents: tuple[int, ...]) -> tuple[_Level, ...]:
    if not parents or parents[0] != -1 or any(not 0 <= p < k for k, p in enumerate(parents) if k):
        raise ValueError(f"parents {parents}: the first must be -1, the others must precede their children")
    depth = [0] * len(parents)
    for joint, parent in enumerate(parents[1:], start=1):
        depth[joint] = depth[parent] + 1
    by_depth = [[j for j, d in enumerate(depth) if d == level] for level in range(max(depth) + 1)]
    slots: list[list[int]] = [[]]
    slots += [[above.index(parents[j]) for j in here] for above, here in pairwise(by_depth)]
    return tuple(_Level(joints, slot) for joints, slot in zip(by_depth, slots, strict=True))


def _order(tree: tuple[_Level, ...]) -> list[int]:
    """Returns where each joint stands in the list of levels."""
    listed = [joint for level in tree for joint in level.joints]
    return [listed.index(joint) for joint in range(len(listed))]


def _parent_joints(joints: Tensor, tree: tuple[_Level, ...]) -> Tensor:
    """Returns the rest position of each joint's parent `[J, 3]`; the origin for the root."""
    parents = [0] * len(joints)
    for above, level in pairwise(tree):
        for joint, slot in zip(level.joints, level.parent_slots, strict=True):
            parents[joint] = above.joints[slot]
    is_root = torch.zeros(len(joints), 1, dtype=torch.bool, device=joints.device)
    is_root[0] = True
    return joints[parents].masked_fill(is_root, 0.0)


def _rigid(rotations: Tensor, translations: Tensor) -> Tensor:
    top = torch.cat([rotations, translations.unsqueeze(-1)], dim=-1)
    bottom = torch.zeros_like(top[:, :1])
    bottom[:, :, 3] = 1.0
    return torch.cat([top, bottom], dim=1)
