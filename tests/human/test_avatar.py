from __future__ import annotations

import copy
import math

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from occfusion.errors import ConfigError, DataError
from occfusion.geometry.rotation import axis_angle_to_matrix, quaternion_to_matrix
from occfusion.human import Avatar, Body
from occfusion.human.avatar import SKINNING_ROWS
from occfusion.human.gaussians import PARAMETERS
from occfusion.splat.harmonics import evaluate
from occfusion.types import Pose
from oracles.people import make_arrays, make_pose
from oracles.rotation import conjugate, exponential
from oracles.skinning import skin_vertex

CENTRE = torch.tensor([0.3, -0.5, 4.0], dtype=torch.float64)
RATES = dict.fromkeys(("means", "sh0", "sh_rest", "opacity", "scales", "quats", "pose", "skinning"), 1e-3)


def plain(body, **options):
    """An avatar without networks, its Gaussians shaken off their start."""
    avatar = Avatar(body, **{"refine_pose": False, "learn_skinning": False, "sh_degree": 1, **options})
    return shake(avatar)


def shake(avatar, seed=0, size=0.05):
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name in PARAMETERS:
            value = getattr(avatar.gaussians, name)
            value.add_(
                torch.randn(value.shape, generator=generator, dtype=torch.float64).to(value), alpha=size
            )
    return avatar


def clouds_equal(a, b, atol=1e-12):
    for name in ("means", "covariances", "opacities", "colors"):
        assert torch.allclose(getattr(a, name), getattr(b, name), atol=atol, rtol=0), name


def test_untouched_gaussians_lie_on_the_posed_body(body):
    avatar = Avatar(body, refine_pose=False, learn_skinning=False)
    for seed in range(3):
        pose = make_pose(seed, angle=1.0)
        vertices, _ = body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)
        assert torch.allclose(avatar(pose, CENTRE).means, vertices, atol=1e-12)


def test_canonical_means_are_the_parameters_and_da_pose_is_canonical(body):
    avatar = plain(body)
    cloud = avatar.canonical(CENTRE)
    assert torch.equal(cloud.means, avatar.gaussians.means)
    clouds_equal(avatar(body.da_pose(), CENTRE), cloud)


def test_deformation_equals_loops(body, arrays):
    """Every Gaussian by itself, from the formulas: inverse blend to rest, blend shapes, blend to the pose."""
    avatar = plain(body)
    pose = make_pose(11, angle=0.7)
    cloud = avatar(pose, CENTRE)
    da, target = body.da_pose(), pose
    state = {name: getattr(avatar.gaussians, name).detach().numpy() for name in PARAMETERS}

    def kinematics(p, betas):
        full = np.concatenate([p.global_orient.numpy(), p.body_pose.numpy()]).reshape(24, 3)
        return [exponential(v) for v in full], arrays.J_template + arrays.J_dirs @ betas

    da_rotations, da_joints = kinematics(da, np.zeros(10))
    rotations, joints = kinematics(target, target.betas.numpy())
    features = [np.concatenate([(r - np.eye(3)).ravel() for r in rs[1:]]) for rs in (da_rotations, rotations)]
    for n, vertex in enumerate(avatar.gaussians.vertex_index.tolist()):
        weights = arrays.weights[vertex]
        at_zero, da_linear = skin_vertex(np.zeros(3), weights, da_rotations, da_joints, arrays.parents)
        rest = np.linalg.solve(da_linear, state["means"][n] - at_zero)
        rest = rest - arrays.posedirs[vertex] @ features[0] + arrays.posedirs[vertex] @ features[1]
        rest = rest + arrays.shapedirs[vertex] @ target.betas.numpy()
        want, linear = skin_vertex(rest, weights, rotations, joints, arrays.parents)
        assert np.allclose(cloud.means[n].detach(), want + target.transl.numpy(), atol=1e-12)
        root = conjugate(state["raw_quats"][n]) @ np.diag(np.exp(state["log_scales"][n]))
        carried = linear @ np.linalg.inv(da_linear) @ root
        assert np.allclose(cloud.covariances[n].detach(), carried @ carried.T, atol=1e-13)
        assert cloud.opacities[n].item() == pytest.approx(1 / (1 + math.exp(-state["opacity_logits"][n])))


def test_rigid_motion_of_body_and_camera(body):
    """Person and camera turned together: the same cloud turned, the same colours, which differ by direction."""
    avatar = plain(body)
    avatar.active_sh_degree = 1
    pose = make_pose(12)
    turn, shift = (
        axis_angle_to_matrix(torch.tensor([0.4, 1.0, -0.7]).double()),
        torch.tensor([1.0, 2, 3]).double(),
    )
    pelvis = body.rest(pose.betas).joints[0]
    moved = Pose(
        pose.betas,
        _axis_angle(turn @ axis_angle_to_matrix(pose.global_orient)),
        pose.body_pose,
        # smplx turns about the pelvis, so the pelvis itself has to be carried by hand
        turn @ (pelvis + pose.transl) + shift - pelvis,
    )
    before, after = avatar(pose, CENTRE), avatar(moved, turn @ CENTRE + shift)
    assert torch.allclose(before.means @ turn.T + shift, after.means, atol=1e-12)
    assert torch.allclose(turn @ before.covariances @ turn.T, after.covariances, atol=1e-12)
    assert (before.colors - after.colors).abs().max() < 1e-12
    assert (before.colors - avatar(moved, CENTRE).colors).abs().max() > 1e-3


def _axis_angle(matrix):
    from oracles.rotation import matrix_to_axis_angle

    return matrix_to_axis_angle(matrix)


def test_colours_of_rigid_limbs_follow_the_turn_back():
    arrays = make_arrays(vertices=10)
    arrays.weights[:] = 0.0
    arrays.weights[:, 5] = 1.0
    avatar = plain(Body(arrays, torch.float64), sh_degree=3)
    avatar.active_sh_degree = 3
    pose = make_pose(13, angle=1.0)
    carried, cloud = avatar.deform(pose), avatar(pose, CENTRE)
    linear = carried.linear.permute(2, 0, 1)
    assert torch.allclose(linear @ linear.mT, torch.eye(3).double().expand(10, 3, 3), atol=1e-12)
    for n in range(10):
        seen = linear[n].T @ (cloud.means[n] - CENTRE)
        want = evaluate(avatar.gaussians.sh(3)[n : n + 1], (seen / seen.norm())[None], 3)
        assert torch.allclose(cloud.colors[n], want[0], atol=1e-12)


def test_bands_that_are_not_active_do_not_colour(body):
    avatar = plain(body, sh_degree=2)
    pose = make_pose(14)
    assert torch.allclose(
        avatar(pose, CENTRE).colors, evaluate(avatar.gaussians.sh0, CENTRE.expand(40, 3), 0)
    )
    avatar.active_sh_degree = 1
    before = avatar(pose, CENTRE).colors
    with torch.no_grad():
        avatar.gaussians.sh_rest[:, 3:] += 1
    assert torch.equal(avatar(pose, CENTRE).colors, before)
    with pytest.raises(ValueError, match="0 to 2"):
        avatar.active_sh_degree = 3


def test_gradients_of_the_whole_chain():
    body = Body(make_arrays(vertices=4), torch.float64)
    avatar = shake(Avatar(body, sh_degree=1), size=0.1)
    avatar.active_sh_degree = 1
    with torch.no_grad():
        avatar.gaussians.sh0 += 3  # away from the clamp at black
    pose = make_pose(15)
    parameters = [getattr(avatar.gaussians, name) for name in PARAMETERS]
    avatar.skinning_field = None  # its own test is below; it is given means without gradient by design

    def run(*inputs):
        swapped = dict(zip(PARAMETERS, inputs[: len(PARAMETERS)], strict=True))
        moved = Pose(*inputs[len(PARAMETERS) :])
        names = {f"gaussians.{name}": value for name, value in swapped.items()}
        cloud = torch.func.functional_call(avatar, names, (moved, CENTRE))
        return cloud.means, cloud.covariances, cloud.opacities, cloud.colors

    inputs = [p.detach().clone().requires_grad_() for p in parameters]
    inputs += [
        t.clone().requires_grad_() for t in (pose.betas, pose.global_orient, pose.body_pose, pose.transl)
    ]
    assert gradcheck(run, inputs, fast_mode=True)


def test_networks_start_with_next_to_no_effect(body):
    torch.manual_seed(0)
    learned, fixed = Avatar(body), Avatar(body, refine_pose=False, learn_skinning=False)
    pose = make_pose(16)
    assert (learned(pose, CENTRE).means - fixed(pose, CENTRE).means).abs().max() < 2e-3
    assert Avatar(body, refine_pose=False).pose_refiner is None
    names = [group["name"] for group in fixed.parameter_groups(RATES)]
    assert names == ["means", "sh0", "sh_rest", "opacity", "scales", "quats"]


def test_parameter_groups_hold_every_parameter_once(body):
    avatar = Avatar(body, skinning_every=4)
    groups = avatar.parameter_groups(RATES)
    held = [id(p) for group in groups for p in group["params"]]
    assert sorted(held) == sorted(id(p) for p in avatar.parameters())
    rates = {group["name"]: group["lr"] for group in groups}
    assert rates["skinning"] == pytest.approx(4e-3) and rates["pose"] == 1e-3
    torch.optim.Adam(groups)
    assert "sh_rest" not in [g["name"] for g in Avatar(body, sh_degree=0).parameter_groups(RATES)]


# -- the schedule of the skinning network


def train(avatar, optimizer, steps, pose):
    for step in steps:
        avatar.prepare(step)
        optimizer.zero_grad()
        cloud = avatar(pose, CENTRE)
        (cloud.means.square().sum() + cloud.covariances.sum() + cloud.colors.sum()).backward()
        optimizer.step()


def start(body, seed=0):
    torch.manual_seed(seed)
    avatar = Avatar(body, sh_degree=1, skinning_every=3)
    return avatar, torch.optim.Adam(avatar.parameter_groups(RATES), eps=1e-15)


def test_skinning_network_learns_at_its_turns_only(body):
    avatar, optimizer = start(body)
    pose = make_pose(17)
    for step in range(7):
        train(avatar, optimizer, [step], pose)
        has_gradient = avatar.skinning_field.last.weight.grad is not None
        assert has_gradient == (step % 3 == 0)


def test_kept_offsets_stand_between_turns_and_rendering_sees_the_present(body):
    avatar, optimizer = start(body)
    pose = make_pose(18)
    train(avatar, optimizer, [0], pose)
    kept = avatar.skinning_offsets.clone()
    with torch.no_grad():
        avatar.skinning_field.last.bias[3] += 2.0
    avatar.prepare(1)
    training = avatar(pose, CENTRE).means.detach()
    with torch.no_grad():
        present = avatar(pose, CENTRE).means
        again = avatar(pose, CENTRE).means
    assert torch.equal(avatar.skinning_offsets, kept)
    assert (training - present).abs().max() > 1e-3
    assert torch.equal(present, again)
    assert torch.allclose(avatar.eval()(pose, CENTRE).means, present, atol=1e-13)


def test_a_pose_as_given_has_nothing_learned_and_teaches_gaussians_alone(body):
    avatar = shake(Avatar(body, sh_degree=1, skinning_every=3), size=0.01).train()
    with torch.no_grad():
        for network in (avatar.pose_refiner, avatar.skinning_field):
            for parameter in network.parameters():
                parameter += 0.05
    pose = make_pose(7)
    avatar.prepare(0)  # the skinning network has its turn
    for _ in range(2):  # nothing is kept of it yet, then something is
        given = avatar.deform(pose, as_given=True)
        learned = avatar.deform(pose)
        assert float((given.means - learned.means).detach().abs().max()) > 1e-4
        given.means.square().sum().backward()
        assert float(avatar.gaussians.means.grad.abs().max()) > 0.0
        for network in (avatar.pose_refiner, avatar.skinning_field):
            assert all(parameter.grad is None for parameter in network.parameters())
    # skinning is as it was learned
    unposed = copy.deepcopy(avatar)
    unposed.pose_refiner = None
    with torch.no_grad():
        torch.testing.assert_close(unposed.deform(pose).means, avatar.deform(pose, as_given=True).means)


def test_rendering_in_inference_mode_does_not_disturb_training(body):
    avatar, optimizer = start(body)
    twin, twin_optimizer = start(body)
    pose = make_pose(19)
    for step in range(5):
        with torch.inference_mode():
            avatar(pose, CENTRE)
            avatar.canonical(CENTRE)
        train(avatar, optimizer, [step], pose)
        train(twin, twin_optimizer, [step], pose)
    for a, b in zip(avatar.parameters(), twin.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("stop", [1, 3, 5])
def test_resumed_training_is_the_same_to_the_last_bit(body, stop):
    pose = make_pose(20)
    through, optimizer = start(body)
    train(through, optimizer, range(8), pose)

    first, optimizer = start(body)
    train(first, optimizer, range(stop), pose)
    saved = copy.deepcopy((first.state_dict(), optimizer.state_dict()))
    resumed, optimizer = start(body, seed=99)
    resumed.load_state_dict(saved[0])
    optimizer.load_state_dict(saved[1])
    train(resumed, optimizer, range(stop, 8), pose)
    for (name, a), b in zip(through.named_parameters(), resumed.parameters(), strict=True):
        assert torch.equal(a, b), name


def test_state_of_another_size_loads(body):
    small = Avatar(Body(make_arrays(vertices=25), torch.float64), sh_degree=1)
    small.active_sh_degree = 1
    small(make_pose(21), CENTRE)  # so that offsets are kept
    target = Avatar(body, sh_degree=1)
    target(make_pose(21), CENTRE)
    optimizer = torch.optim.Adam(target.parameter_groups(RATES))
    target.load_state_dict(small.state_dict())
    assert target.gaussians.num_gaussians == 25 and target.active_sh_degree == 1
    for name in PARAMETERS:
        assert torch.equal(getattr(target.gaussians, name), getattr(small.gaussians, name))
    assert torch.equal(target.skinning_offsets, small.skinning_offsets)
    train(
        target, optimizer, range(2), make_pose(21)
    )  # the optimiser made before still moves what is there now
    assert not torch.equal(target.gaussians.means, small.gaussians.means)


def test_state_with_other_bands_is_refused(body):
    with pytest.raises(RuntimeError, match="size mismatch"):
        Avatar(body, sh_degree=1).load_state_dict(Avatar(body, sh_degree=2).state_dict())


def test_refreshed_vertices_are_the_nearest(body):
    avatar = plain(body)
    with torch.no_grad():
        avatar.gaussians.means += 0.1
    avatar.refresh_vertex_index()
    distances = torch.cdist(avatar.gaussians.means, body.da_vertices())
    assert torch.equal(avatar.gaussians.vertex_index, distances.argmin(dim=1))


# -- extremes


@pytest.mark.stiff
@pytest.mark.parametrize("angle", [0.0, 1e-12, math.pi, 2 * math.pi, 100.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extreme_angles_give_finite_clouds_and_gradients(angle, dtype):
    body = Body(make_arrays(vertices=20), dtype)
    avatar = Avatar(body, sh_degree=1)
    avatar.active_sh_degree = 1
    body_pose = torch.zeros(69, dtype=dtype)
    body_pose[::3] = angle
    pose = Pose(
        torch.zeros(10, dtype=dtype),
        torch.full((3,), angle, dtype=dtype),
        body_pose,
        torch.zeros(3, dtype=dtype),
    )
    inputs = [pose.body_pose.requires_grad_(), pose.global_orient.requires_grad_(), *avatar.parameters()]
    cloud = avatar(pose, CENTRE)
    total = cloud.means.sum() + cloud.covariances.sum() + cloud.colors.sum() + cloud.opacities.sum()
    gradients = torch.autograd.grad(total, inputs)
    assert all(
        bool(torch.isfinite(t).all()) for t in (*gradients, cloud.means, cloud.covariances, cloud.colors)
    )


@pytest.mark.stiff
def test_opposed_weights_at_half_a_turn():
    """The candy wrapper: half the weight on a bone twisted by 180 degrees makes the blend singular."""
    arrays = make_arrays(vertices=20, pose_shapes=False)
    arrays.weights[:] = 0.0
    arrays.weights[:, [18, 20]] = 0.5
    avatar = plain(Body(arrays, torch.float64))
    pose = make_pose(22, angle=0.0)
    twist = pose.body_pose.view(23, 3)
    twist[19, 0] = math.pi
    cloud = avatar(pose, CENTRE)
    cloud.covariances.sum().backward()
    eigenvalues = torch.linalg.eigvalsh(cloud.covariances.detach())
    assert eigenvalues[:, 1].abs().max() < 1e-15 and eigenvalues[:, 2].min() > 1e-6, "flattened to a line"
    assert all(
        bool(torch.isfinite(p.grad).all()) for p in (avatar.gaussians.raw_quats, avatar.gaussians.log_scales)
    )


@pytest.mark.parametrize("count", [0, 1])
def test_none_and_one(body, count):
    avatar = Avatar(body, sh_degree=1)
    rows = {name: getattr(avatar.gaussians, name)[:count] for name in PARAMETERS}
    avatar.gaussians.replace(rows, torch.zeros(count, dtype=torch.int64))
    avatar.forget_skinning()
    avatar.prepare(0)
    avatar.refresh_vertex_index()
    assert avatar(make_pose(23), CENTRE).covariances.shape == (count, 3, 3)
    assert avatar.canonical(CENTRE).colors.shape == (count, 3)


def test_single_precision_agrees_with_double(body, arrays):
    pose = make_pose(24)
    single = Avatar(Body(arrays), refine_pose=False, learn_skinning=False)
    double = Avatar(body, refine_pose=False, learn_skinning=False)
    a, b = single(pose, CENTRE), double(pose, CENTRE)
    assert a.means.dtype == torch.float32
    assert (a.means.double() - b.means).abs().max() < 5e-6
    assert (
        (a.covariances.double() - b.covariances).abs().amax((1, 2)) / b.covariances.abs().amax((1, 2))
    ).max() < 1e-5


def test_bad_settings(body):
    with pytest.raises(ConfigError, match="skinning_every"):
        Avatar(body, skinning_every=0)
    with pytest.raises(ValueError, match="sh_degree"):
        Avatar(body, sh_degree=4)
    pose = make_pose(25)
    with pytest.raises(DataError, match="betas"):
        Avatar(body)(Pose(torch.ones(12), pose.global_orient, pose.body_pose, pose.transl), CENTRE)


def test_covariances_are_symmetric_and_rotations_of_quaternions_matter(body):
    avatar = plain(body)
    cloud = avatar(make_pose(26), CENTRE)
    assert torch.equal(cloud.covariances, cloud.covariances.mT)
    roots = avatar.gaussians.roots()
    rotations = quaternion_to_matrix(avatar.gaussians.raw_quats)
    assert torch.allclose(roots, rotations @ torch.diag_embed(avatar.gaussians.scales), atol=1e-15)


def test_the_skinning_network_goes_round_the_gaussians(body):
    """A turn changes the kept offsets of its rows alone, to what the network gives there; all rows have their turn."""
    avatar, optimizer = start(body)
    pose = make_pose(20)
    train(avatar, optimizer, [0], pose)
    changed = torch.zeros(avatar.gaussians.num_gaussians, dtype=torch.bool)
    for turn in range(1, 1 + SKINNING_ROWS):
        with torch.no_grad():
            avatar.skinning_field.last.bias.add_(0.1 * torch.randn(24, dtype=torch.float64))
        before = avatar.skinning_offsets
        avatar.prepare(3 * turn)
        with torch.no_grad():
            wanted = avatar.skinning_field(avatar.gaussians.means)
        avatar(pose, CENTRE)
        rows = (avatar.skinning_offsets != before).any(dim=1)
        assert rows.nonzero()[:, 0].tolist() == list(range(turn % SKINNING_ROWS, len(rows), SKINNING_ROWS))
        assert torch.allclose(avatar.skinning_offsets[rows], wanted[rows], atol=1e-12)
        changed |= rows
    assert changed.all()


def test_a_turn_has_the_gradient_of_its_rows(body):
    """That of the whole network, with the other rows' offsets taken as fixed."""
    avatar, optimizer = start(body)
    pose = make_pose(21)
    train(avatar, optimizer, [0], pose)
    kept = avatar.skinning_offsets.clone()
    avatar.prepare(3)
    cloud = avatar(pose, CENTRE)
    weights = torch.randn(cloud.means.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    last = avatar.skinning_field.last.bias
    (found,) = torch.autograd.grad((cloud.means * weights).sum(), last)
    rows = torch.arange(len(kept)) % SKINNING_ROWS == 1

    def whole() -> torch.Tensor:
        offsets = torch.where(rows[:, None], avatar.skinning_field(avatar.gaussians.means.detach()), kept)
        avatar._binding = lambda **_: avatar._bind_offsets(offsets)
        return (avatar(pose, CENTRE).means * weights).sum()

    (wanted,) = torch.autograd.grad(whole(), last)
    assert torch.allclose(found, wanted, atol=1e-10, rtol=1e-10) and found.abs().max() > 0


@pytest.mark.parametrize("lamp", [None, (0.3, -0.2, 0.5)])
def test_gaussians_posed_from_tensors_alone_are_those_of_the_avatar(body, lamp):
    """What a GPU records of a step reads nothing else: the tensors may lie elsewhere by the next call."""
    avatar = plain(body, sh_degree=1, key_light=None if lamp is None else torch.tensor(lamp).double())
    shake(avatar)
    avatar.active_sh_degree = 1
    gaussians, centre = avatar.gaussians, torch.tensor([0.2, 0.1, -3.0], dtype=torch.float64)
    placed = avatar._placed(body.da_pose())
    wanted = avatar._posed(gaussians, placed, centre, avatar.da_normals, avatar.key_light)
    given = (*placed, centre, avatar.da_normals, *gaussians.tensors())
    copies = [tensor.detach().clone().requires_grad_(tensor.requires_grad) for tensor in given]
    found = avatar._posed_by_tensors(*copies, *(() if avatar.key_light is None else (avatar.key_light,)))
    weights = [torch.rand_like(value) for value in wanted]
    leaves = [tensor for tensor in copies if tensor.requires_grad]
    assert len(leaves) == len(list(gaussians.parameters()))
    gradients = torch.autograd.grad(found, leaves, weights)
    for ours, theirs in zip(found, wanted, strict=True):
        assert torch.equal(ours, theirs)
    parameters = [tensor for tensor in given if tensor.requires_grad]
    for ours, theirs in zip(gradients, torch.autograd.grad(wanted, parameters, weights), strict=True):
        assert torch.equal(ours, theirs)
