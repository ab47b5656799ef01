from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from occfusion.geometry import skinning
from occfusion.geometry.rotation import axis_angle_to_matrix
from oracles.rotation import exponential
from oracles.skinning import place_joint, skin_vertex

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)


def scene(seed=0, points=12, joints=24, angle=1.0):
    rng = np.random.default_rng(seed)
    weights = rng.random((points, joints)) ** 4
    weights /= weights.sum(axis=1, keepdims=True)
    return (
        rng.normal(size=(joints, 3)) * angle,
        rng.normal(size=(joints, 3)),
        rng.normal(size=(points, 3)),
        weights,
    )


@pytest.mark.parametrize("parents", [PARENTS, (-1, 0, 1, 2, 3), (-1, 0, 0, 0, 0), (-1,), (-1, 0, 0, 2, 1, 3)])
def test_kinematics_equal_recursion(parents):
    angles, joints, _, _ = scene(joints=len(parents))
    rotations = [exponential(v) for v in angles]
    got = skinning.bone_transforms(axis_angle_to_matrix(torch.tensor(angles)), torch.tensor(joints), parents)
    placed = skinning.posed_joints(got, torch.tensor(joints)).numpy()
    for k in range(len(parents)):
        rotation, place = place_joint(k, rotations, joints, parents)
        assert np.abs(got[k, :3, :3].numpy() - rotation).max() < 1e-13
        assert np.abs(placed[k] - place).max() < 1e-13
        assert got[k, 3].tolist() == [0, 0, 0, 1]


def test_blend_skinning_equals_loop_over_joints():
    angles, joints, points, weights = scene(1)
    rotations = [exponential(v) for v in angles]
    covariances = np.array([a @ a.T for a in np.random.default_rng(2).normal(size=(len(points), 3, 3))])
    transforms = skinning.bone_transforms(
        axis_angle_to_matrix(torch.tensor(angles)), torch.tensor(joints), PARENTS
    )
    maps = skinning.blend(torch.tensor(weights), transforms)
    moved = skinning.skin_points(torch.tensor(points), maps).numpy()
    spread = skinning.skin_covariances(torch.tensor(covariances), maps).numpy()
    for n, (point, row) in enumerate(zip(points, weights, strict=True)):
        position, linear = skin_vertex(point, row, rotations, joints, PARENTS)
        assert np.abs(moved[n] - position).max() < 1e-13
        assert np.abs(spread[n] - linear @ covariances[n] @ linear.T).max() < 1e-12


def test_rest_pose_moves_nothing():
    _, joints, points, weights = scene(3)
    transforms = skinning.bone_transforms(
        torch.eye(3).double().expand(24, 3, 3), torch.tensor(joints), PARENTS
    )
    maps = skinning.blend(torch.tensor(weights), transforms)
    assert np.abs(skinning.skin_points(torch.tensor(points), maps).numpy() - points).max() < 1e-14


def test_turning_the_root_turns_everything_about_the_root_joint():
    angles, joints, points, weights = (torch.tensor(a) for a in scene(4))
    turn = axis_angle_to_matrix(torch.tensor([0.3, -2.0, 1.0]).double())
    rotations = axis_angle_to_matrix(angles)
    turned = rotations.clone()
    turned[0] = turn @ rotations[0]

    def move(r):
        return skinning.skin_points(
            points, skinning.blend(weights, skinning.bone_transforms(r, joints, PARENTS))
        )

    about = joints[0]
    assert torch.allclose(move(turned), (move(rotations) - about) @ turn.T + about, atol=1e-13)


def test_weights_of_one_joint_move_rigidly():
    angles, joints, points, _ = (torch.tensor(a) for a in scene(5))
    weights = torch.zeros(len(points), 24, dtype=torch.float64)
    weights[:, 17] = 1.0
    transforms = skinning.bone_transforms(axis_angle_to_matrix(angles), joints, PARENTS)
    moved = skinning.skin_points(points, skinning.blend(weights, transforms))
    assert torch.allclose(torch.cdist(moved, moved), torch.cdist(points, points), atol=1e-12)


def test_permuting_points_permutes_the_result():
    angles, joints, points, weights = (torch.tensor(a) for a in scene(6))
    transforms = skinning.bone_transforms(axis_angle_to_matrix(angles), joints, PARENTS)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    straight = skinning.skin_points(points, skinning.blend(weights, transforms))
    shuffled = skinning.skin_points(points[order], skinning.blend(weights[order], transforms))
    assert torch.allclose(straight[order], shuffled, atol=1e-15)


def test_inverse_of_affine_maps():
    maps = torch.randn(20, 3, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    back = skinning.skin_points(skinning.skin_points(points, maps), skinning.invert_affine(maps))
    assert torch.allclose(back, points, atol=1e-9)
    assert torch.allclose(skinning.invert_affine(maps)[:, :, :3], torch.linalg.inv(maps[:, :, :3]), rtol=1e-9)


@pytest.mark.stiff
@pytest.mark.parametrize("angle", [math.pi, math.pi - 1e-6, math.pi / 2])
def test_opposed_twists_flatten_but_stay_finite(angle):
    joints = torch.zeros(2, 3, dtype=torch.float64)
    twist = torch.tensor([[0.0, 0, 0], [0.0, 0, angle]], dtype=torch.float64, requires_grad=True)
    maps = skinning.blend(
        torch.full((1, 2), 0.5, dtype=torch.float64),
        skinning.bone_transforms(axis_angle_to_matrix(twist), joints, (-1, 0)),
    )
    covariance = skinning.skin_covariances(torch.eye(3, dtype=torch.float64)[None], maps)
    # the mean of a turn by a and none scales the plane by cos(a / 2), the axis not at all
    want = [math.cos(angle / 2) ** 2] * 2 + [1.0]
    assert np.allclose(torch.linalg.eigvalsh(covariance[0]).tolist(), want, atol=1e-15)
    covariance.sum().backward()
    assert torch.isfinite(twist.grad).all()


def test_gradients():
    angles, joints, points, weights = (torch.tensor(a) for a in scene(7, points=3, joints=5))
    parents = (-1, 0, 1, 1, 2)

    def move(a, j, p, w):
        maps = skinning.blend(w, skinning.bone_transforms(axis_angle_to_matrix(a), j, parents))
        return skinning.skin_points(p, maps), skinning.skin_covariances(
            torch.eye(3).double().expand(3, 3, 3), maps
        )

    inputs = [t.requires_grad_() for t in (angles, joints, points, weights)]
    assert gradcheck(move, inputs)


def test_gradient_of_the_inverse():
    maps = torch.randn(3, 3, 4, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    assert gradcheck(skinning.invert_affine, (maps + torch.eye(3, 4) * 2).requires_grad_())


@pytest.mark.parametrize("parents", [(), (0, 0), (-1, 1), (-1, 2, 0), (-1, -1)])
def test_no_tree(parents):
    n = len(parents)
    with pytest.raises(ValueError, match="parents"):
        skinning.bone_transforms(torch.eye(3).expand(n, 3, 3), torch.zeros(n, 3), parents)
