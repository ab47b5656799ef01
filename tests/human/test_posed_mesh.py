"""Meshes posed for looking: against loops over vertices and joints, and against the body's own forward pass."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from occfusion.files.bodyfile import BodyArrays
from occfusion.human import Body, embedded_body
from occfusion.human.body import without_pose_blend_shapes
from occfusion.human.posed_mesh import MeshPoser, mesh_poser
from occfusion.types import Pose
from oracles.rotation import exponential
from oracles.skinning import place_joint, pose_body


def pose_of(seed: int, scale: float, betas: int = 10) -> Pose:
    generator = torch.Generator().manual_seed(seed)

    def drawn(*shape: int) -> torch.Tensor:
        return scale * torch.randn(*shape, generator=generator, dtype=torch.float64)

    return Pose(drawn(betas), drawn(3), drawn(69), drawn(3))


@pytest.mark.parametrize(("seed", "scale"), [(0, 0.3), (1, 1.0), (2, 3.0)])
@pytest.mark.parametrize("blended", [True, False])
def test_vertices_and_joints_are_those_of_loops(
    arrays: BodyArrays, seed: int, scale: float, blended: bool
) -> None:
    """Loops in float64; with and without pose blend shapes, and with all 24 joints at every vertex."""
    body = Body(arrays, torch.float64)
    if not blended:
        body, arrays = without_pose_blend_shapes(body), replace(arrays, posedirs=None)
    pose = pose_of(seed, scale, body.num_betas)
    mesh = MeshPoser(body).pose(pose)
    parts = (part.numpy() for part in (pose.betas, pose.global_orient, pose.body_pose, pose.transl))
    vertices, joints = pose_body(arrays, *parts)
    np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-11)
    np.testing.assert_allclose(mesh.joints, joints, atol=1e-11)


def test_turns_are_multiplied_from_the_right_and_shifts_added(arrays: BodyArrays) -> None:
    body = Body(arrays, torch.float64)
    pose, rng = pose_of(3, 0.5, body.num_betas), np.random.default_rng(0)
    turns, shift = 0.4 * rng.normal(size=(24, 3)), rng.normal(size=3)
    given = np.concatenate([pose.global_orient.numpy(), pose.body_pose.numpy()]).reshape(24, 3)
    rotations = [exponential(one) @ exponential(other) for one, other in zip(given, turns, strict=True)]
    mesh = MeshPoser(body).pose(pose, turns, shift)
    placed = [place_joint(k, rotations, mesh.rest_joints, arrays.parents)[1] for k in range(24)]
    np.testing.assert_allclose(mesh.joints, np.array(placed) + pose.transl.numpy() + shift, atol=1e-11)


def test_the_embedded_body_is_posed_as_its_forward_pass_does() -> None:
    body, pose = embedded_body(), pose_of(4, 0.4)
    vertices, joints = body(
        *(part.float() for part in (pose.betas, pose.global_orient, pose.body_pose, pose.transl))
    )
    mesh = mesh_poser(body).pose(pose)
    np.testing.assert_allclose(mesh.vertices, vertices.numpy(), atol=2e-6)
    np.testing.assert_allclose(mesh.joints, joints.numpy(), atol=2e-6)
    assert mesh_poser(body) is mesh_poser(body) and mesh_poser(body).closed


@pytest.mark.parametrize("scale", [0.2, 1.5])
def test_derivatives_are_central_differences(arrays: BodyArrays, scale: float) -> None:
    """Of all turns and shape components, at vertices that hang on all joints: without pose blend shapes."""
    body = without_pose_blend_shapes(Body(arrays, torch.float64))
    poser, pose, rng = MeshPoser(body), pose_of(5, scale, body.num_betas), np.random.default_rng(1)
    chosen = np.array([0, 5, 5, 11])
    along = rng.normal(size=(len(chosen), 3))
    by_turns, by_shape = poser.derivatives(poser.pose(pose), chosen, along)
    step = 1e-6
    for column in range(72):
        turns = np.zeros(72)
        turns[column] = step
        ahead, behind = (poser.pose(pose, sign * turns.reshape(24, 3)).vertices[chosen] for sign in (1, -1))
        wanted = ((ahead - behind) * along).sum(axis=1) / (2 * step)
        np.testing.assert_allclose(by_turns[:, column], wanted, atol=1e-7)
    for component in range(body.num_betas):
        betas = torch.zeros_like(pose.betas)
        betas[component] = step
        ahead, behind = (
            poser.pose(replace(pose, betas=pose.betas + sign * betas)).vertices[chosen] for sign in (1, -1)
        )
        wanted = ((ahead - behind) * along).sum(axis=1) / (2 * step)
        np.testing.assert_allclose(by_shape[:, component], wanted, atol=1e-7)


@pytest.mark.stiff
@pytest.mark.parametrize("angle", [0.0, 1e-30, 1e-9, math.pi, 2 * math.pi, 1e3, 1e8])
def test_extreme_turns_stay_rigid(arrays: BodyArrays, angle: float) -> None:
    """Whatever the angles, bones keep their lengths."""
    body = Body(arrays, torch.float64)
    pose = replace(
        pose_of(6, 0.0, body.num_betas),
        global_orient=torch.tensor([angle, 0.0, 0.0], dtype=torch.float64),
        body_pose=torch.full((69,), angle / math.sqrt(3), dtype=torch.float64),
    )
    mesh = MeshPoser(body).pose(pose)
    assert np.isfinite(mesh.vertices).all()
    above = np.array(arrays.parents[1:])
    lengths = np.linalg.norm(mesh.joints[1:] - mesh.joints[above], axis=1)
    np.testing.assert_allclose(
        lengths, np.linalg.norm(mesh.rest_joints[1:] - mesh.rest_joints[above], axis=1), rtol=1e-9
    )
