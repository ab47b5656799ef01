"""Compiled kinematics against the specification in double precision, by loops over joints, and by invariants."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.geometry.skinning import bone_transforms

PARENTS = (-1, 0, 0, 1, 1, 3, 5, 2, 7, 8, 4)


def made(dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    turns = torch.randn(len(PARENTS), 3, generator=generator, dtype=torch.float64)
    joints = torch.randn(len(PARENTS), 3, generator=generator, dtype=torch.float64)
    return axis_angle_to_matrix(turns).to(dtype), joints.to(dtype)


def test_every_joint_follows_its_parent() -> None:
    rotations, joints = made(torch.float32)
    found = bone_transforms(rotations, joints, PARENTS, compiled=True)
    for joint, parent in enumerate(PARENTS):
        about = torch.eye(4)
        about[:3, :3] = rotations[joint]
        about[:3, 3] = joints[joint] - rotations[joint] @ joints[joint]
        above = torch.eye(4) if parent < 0 else found[parent]
        assert_close(found[joint], above @ about, atol=3e-6, rtol=1e-5)


def test_gradients_are_those_of_the_specification_for_rotations_and_joints() -> None:
    weights = torch.randn(len(PARENTS), 4, 4, generator=torch.Generator().manual_seed(1)).double()
    weights[:, 3] = 0.0  # the last row is fixed
    found, wanted = [], []
    for dtype, out, compiled in ((torch.float32, found, True), (torch.float64, wanted, False)):
        leaves = [tensor.requires_grad_() for tensor in made(dtype)]
        transforms = bone_transforms(*leaves, PARENTS, compiled=compiled)
        (transforms * weights.to(dtype)).sum().backward()
        out += [transforms.detach(), *(leaf.grad for leaf in leaves)]
    rotations, _ = made(torch.float64)

    def tangent(gradient: torch.Tensor) -> torch.Tensor:
        """What of a gradient turns: beyond that the specification is free, since rotations stay rotations."""
        own = rotations.transpose(1, 2) @ gradient.double()
        return own - own.transpose(1, 2)

    assert_close(found[0].double(), wanted[0], atol=3e-6, rtol=1e-5)
    assert_close(tangent(found[1]), tangent(wanted[1]), atol=2e-5, rtol=1e-5)
    assert_close(found[2].double(), wanted[2], atol=2e-5, rtol=1e-5)


def test_gradients_are_those_of_differences() -> None:
    weights = torch.randn(len(PARENTS), 3, 4, generator=torch.Generator().manual_seed(2)).double()
    rotations, joints = (tensor.requires_grad_() for tensor in made(torch.float32))
    (bone_transforms(rotations, joints, PARENTS, compiled=True)[:, :3] * weights.float()).sum().backward()
    exact, places = made(torch.float64)
    step = 1e-6
    for joint in range(len(PARENTS)):
        for k in range(3):
            turn = torch.zeros(3, dtype=torch.float64)
            turn[k] = step
            sides = []
            for small in (axis_angle_to_matrix(turn), axis_angle_to_matrix(-turn)):
                turned = exact.clone()
                turned[joint] = turned[joint] @ small
                sides.append((bone_transforms(turned, places, PARENTS)[:, :3] * weights).sum())
            skewed = exact[joint].T @ rotations.grad[joint].double()
            i, j = ((2, 1), (0, 2), (1, 0))[k]
            assert float(skewed[i, j] - skewed[j, i]) == pytest.approx(
                float(sides[0] - sides[1]) / (2 * step), abs=1e-4, rel=1e-4
            )


def test_no_turn_moves_nothing_and_a_wrong_tree_is_refused() -> None:
    _, joints = made(torch.float32)
    still = torch.eye(3).expand(len(PARENTS), 3, 3)
    found = bone_transforms(still, joints, PARENTS, compiled=True)
    assert_close(found, torch.eye(4).expand_as(found), atol=1e-6, rtol=0)
    with pytest.raises(ValueError, match="parents"):
        bone_transforms(still[:2], joints[:2], (-1, 1), compiled=True)
