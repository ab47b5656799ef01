from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from occfusion.errors import DataError
from occfusion.files.bodyfile import save_body_arrays
from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.human import Body, embedded_body, load_body
from occfusion.human.body import DA_POSE, leading_betas
from oracles.people import make_arrays, make_pose
from oracles.skinning import pose_body


def unpack(pose):
    return pose.betas, pose.global_orient, pose.body_pose, pose.transl


@pytest.mark.parametrize("pose_shapes", [True, False])
@pytest.mark.parametrize("seed", [0, 1])
def test_body_equals_the_formula(pose_shapes, seed):
    arrays = make_arrays(vertices=15, pose_shapes=pose_shapes, seed=seed)
    pose = make_pose(seed, angle=1.0)
    vertices, joints = Body(arrays, torch.float64)(*unpack(pose))
    want_vertices, want_joints = pose_body(arrays, *(t.numpy() for t in unpack(pose)))
    assert np.abs(vertices.numpy() - want_vertices).max() < 1e-12
    assert np.abs(joints.numpy() - want_joints).max() < 1e-12


def test_single_precision_is_close(arrays):
    pose = make_pose(3, angle=1.0)
    exact = Body(arrays, torch.float64)(*unpack(pose))[0]
    single = Body(arrays)(*(t.float() for t in unpack(pose)))[0]
    assert (single.double() - exact).abs().max() < 5e-6


def test_no_shape_no_pose_is_the_template(body, arrays):
    vertices, joints = body(*(torch.zeros(n, dtype=torch.float64) for n in (10, 3, 69, 3)))
    assert np.abs(vertices.numpy() - arrays.v_template).max() < 1e-14
    assert np.abs(joints.numpy() - arrays.J_template).max() < 1e-14


def test_root_turns_about_the_pelvis_and_commutes_with_skinning(body):
    pose = make_pose(4)
    turn = axis_angle_to_matrix(pose.global_orient)
    still = body(pose.betas, torch.zeros(3), pose.body_pose, torch.zeros(3))
    turned = body(*unpack(pose))
    pelvis = body.rest(pose.betas).joints[0]
    for a, b in zip(still, turned, strict=True):
        assert torch.allclose((a - pelvis) @ turn.T + pelvis + pose.transl, b, atol=1e-13)
    assert torch.allclose(turned[1][0], pelvis + pose.transl)


def test_fewer_betas_are_completed_with_zeros(body):
    pose = make_pose(5)
    short = pose.betas[:4]
    full = torch.cat([short, torch.zeros(6, dtype=torch.float64)])
    assert torch.equal(body(short, *unpack(pose)[1:])[0], body(full, *unpack(pose)[1:])[0])
    assert torch.equal(body.rest(torch.zeros(0)).vertices, body.v_template)


def test_pose_in_either_shape(body):
    pose = make_pose(6)
    a = body(*unpack(pose))[0]
    b = body(pose.betas, pose.global_orient, pose.body_pose.view(23, 3), pose.transl)[0]
    assert torch.equal(a, b)


def test_wrong_sizes(body):
    pose = make_pose(7)
    with pytest.raises(DataError, match="one vector"):
        body(torch.zeros(1, 10), *unpack(pose)[1:])
    with pytest.raises(DataError, match="69"):
        body(pose.betas, pose.global_orient, torch.zeros(63), pose.transl)


def test_shape_components_that_the_body_lacks():
    """AMASS gives 16 numbers: left out exactly where they are zero, else only when asked to."""
    arrays, pose = make_arrays(vertices=6), make_pose(7)
    strict, cutting = Body(arrays, torch.float64), Body(arrays, torch.float64, cut_betas=True)
    wanted = strict(*unpack(pose))[0]
    zeros = torch.cat([pose.betas, torch.zeros(6, dtype=torch.float64)])
    more = torch.cat([pose.betas, torch.full((6,), 0.1, dtype=torch.float64)])
    assert torch.equal(strict(zeros, *unpack(pose)[1:])[0], wanted)
    assert torch.equal(cutting(more, *unpack(pose)[1:])[0], wanted)
    with pytest.raises(DataError, match=r"16 shape components, and the body has 10.*body\.cut_betas=true"):
        strict(more, *unpack(pose)[1:])


def test_leading_betas_in_numpy():
    betas = np.zeros((3, 16))
    betas[:, :10] = 1.0
    assert leading_betas(betas, 300, "poses.npz") is betas
    np.testing.assert_array_equal(leading_betas(betas, 10, "poses.npz"), np.ones((3, 10)))
    for wrong in (1e-9, np.nan):
        betas[2, 15] = wrong
        with pytest.raises(DataError, match=r"poses\.npz, betas: 16 shape components"):
            leading_betas(betas, 10, "poses.npz, betas")
        assert leading_betas(betas, 10, "poses.npz, betas", cut=True).shape == (3, 10)


def test_gradient():
    body = Body(make_arrays(vertices=6), torch.float64)
    pose = make_pose(8)
    assert gradcheck(lambda *p: body(*p), [t.requires_grad_() for t in unpack(pose)], fast_mode=True)


def test_da_pose_is_the_body_in_that_pose(body):
    assert torch.allclose(body(*unpack(body.da_pose()))[0], body.da_vertices(), atol=1e-14)
    assert DA_POSE[0] == (1, math.radians(45))


def test_da_blend_is_regular_for_any_weights(body):
    """The promise that lets `bind` invert it: determinant at least 1/2, equal hips the worst."""
    linear = body.da_transforms()[:, :3, :3]
    weights = torch.distributions.Dirichlet(torch.full((24,), 0.05, dtype=torch.float64))
    torch.manual_seed(0)
    blends = torch.einsum("nj,jab->nab", weights.sample((2000,)), linear)
    pairs = torch.zeros(24 * 24, 24, dtype=torch.float64)
    for n in range(24 * 24):
        pairs[n, n // 24] += 0.5
        pairs[n, n % 24] += 0.5
    worst = torch.linalg.det(torch.cat([blends, torch.einsum("nj,jab->nab", pairs, linear)])).min()
    assert float(worst) == pytest.approx(0.5)


def test_files_of_each_kind_give_the_same_body(tmp_path, arrays):
    pose = make_pose(9)
    want = Body(arrays)(*(t.float() for t in unpack(pose)))[0]
    for suffix in (".npz", ".safetensors"):
        save_body_arrays(tmp_path / f"body{suffix}", arrays)
        got = load_body(tmp_path / f"body{suffix}")
        assert torch.allclose(got(*(t.float() for t in unpack(pose)))[0], want, atol=1e-6)


def test_digest_tells_bodies_apart_and_not_precisions(arrays):
    assert Body(arrays).digest() == Body(arrays, torch.float64).digest()
    assert Body(arrays).digest() != Body(make_arrays(seed=1)).digest()
    assert Body(arrays).digest() != Body(make_arrays(pose_shapes=False)).digest()


def test_state_carries_no_copy_of_the_body(body):
    assert not body.state_dict()


def test_embedded_body_stands_upright_with_legs_apart():
    body = embedded_body()
    assert body.num_vertices == 6890 and body.num_betas == 10
    height = body.v_template.amax(0) - body.v_template.amin(0)
    assert 1.4 < float(height[1]) < 2.1
    assert torch.allclose(body.weights.sum(1), torch.ones(6890), atol=1e-5)
    ankles = body(*unpack(body.da_pose()))[1][[7, 8]]
    assert float(ankles[0, 0] - ankles[1, 0]) > 0.8, "left is +x, and the feet are far apart"
