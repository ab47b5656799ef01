from __future__ import annotations

import copy

import pytest
import torch

from occfusion.errors import ConfigError
from occfusion.human import Avatar, Body
from occfusion.human.densify import Densification, Densifier
from occfusion.human.gaussians import PARAMETERS
from occfusion.types import Camera
from oracles.people import make_arrays, make_pose

CAMERA = Camera(torch.eye(4), torch.eye(3), 400, 300)
EASY = Densification(min_gaussians=1)


@pytest.fixture
def avatar(body):
    avatar = Avatar(body, sh_degree=0, refine_pose=False, learn_skinning=True)
    with torch.no_grad():
        avatar.gaussians.opacity_logits.fill_(2.0)
        avatar.gaussians.log_scales.fill_(-5.0)  # 7 mm: small
    return avatar


def observe(densifier, n, moving=(), size=1.0, drawn=None):
    """One picture in which the gradients of `moving` are `size` in 3DGS units, the others 0."""
    gradient = torch.zeros(n, 2, dtype=torch.float64)
    for row in moving:
        gradient[row] = torch.tensor([size / 200, 0.0])
    radii = torch.ones(n, 2)
    if drawn is not None:
        radii[[row for row in range(n) if row not in drawn]] = 0
    densifier.observe(gradient, radii, CAMERA)


def run(avatar, moving=(), settings=EASY, step=600, optimizer=None, **kwargs):
    densifier = Densifier(settings)
    observe(densifier, avatar.gaussians.num_gaussians, moving, **kwargs)
    return densifier.step(step, avatar, optimizer)


def test_schedule():
    due = [step for step in range(3000) if Densifier().is_due(step)]
    assert due == [600, 800, 1000, 1200, 1400, 1600, 1800, 2000, 2200]


def test_gradient_is_in_units_of_a_picture_two_wide_and_high_and_free_of_the_loss_scale():
    for scale in (1.0, 1e4):
        densifier = Densifier(loss_scale=scale)
        gradient = torch.tensor([[3e-3, 0.0], [0.0, 3e-3], [3e-3, 4e-3]]) * scale
        densifier.observe(gradient, torch.tensor([[1, 1], [1, 1], [0, 0]]), CAMERA)
        densifier.observe(gradient, torch.tensor([[1, 1], [0, 0], [0, 0]]), CAMERA)
        assert densifier.gradient_sum.tolist() == pytest.approx([2 * 3e-3 * 200, 3e-3 * 150, 0.0])
        assert densifier.count.tolist() == [2, 1, 0]


def test_small_moving_gaussians_far_from_others_are_cloned(avatar):
    done = run(avatar, moving=(3, 8))
    assert (done.cloned, done.split, done.merged, done.total) == (2, 0, 0, 42 - done.pruned)


def test_large_moving_gaussians_are_split(avatar):
    with torch.no_grad():
        avatar.gaussians.log_scales[3] = -4.0  # 18 mm
    done = run(avatar, moving=(3, 8), settings=Densification(min_gaussians=1, from_body=9.0))
    assert (done.cloned, done.split, done.total) == (1, 1, 42)


def test_gaussians_like_their_neighbour_are_merged_instead(avatar):
    with torch.no_grad():
        avatar.gaussians.means[4] = avatar.gaussians.means[3] + 1e-4
    done = run(avatar, moving=(3, 4))
    assert (done.cloned, done.split, done.merged, done.total) == (0, 0, 1, 39)


def test_neither_alike_nor_apart_stays(avatar):
    with torch.no_grad():  # half a standard deviation and more: KL 0.25
        avatar.gaussians.means[4] = avatar.gaussians.means[3] + torch.tensor([0.0, 0.0, 0.0048])
    done = run(avatar, moving=(3, 4))
    assert (done.cloned, done.split, done.merged, done.total) == (0, 0, 0, 40)


def test_the_calm_and_the_unseen_stay(avatar):
    assert run(avatar, moving=(3,), size=1.9e-4).total == 40
    assert run(avatar, moving=(3,), drawn=(1, 2)).total == 40


def test_faint_and_stray_gaussians_are_removed(avatar):
    with torch.no_grad():
        avatar.gaussians.opacity_logits[5] = -5.5  # 0.0041
        avatar.gaussians.opacity_logits[6] = -5.2  # 0.0055
        avatar.gaussians.means[7, 1] += 20.0
    kept = [n for n in range(40) if n not in (5, 7)]
    want = avatar.gaussians.means[kept].detach().clone()
    done = run(avatar)
    assert (done.pruned, done.total, done.prune_refused) == (2, 38, False)
    assert torch.equal(avatar.gaussians.means, want)
    distances = torch.cdist(want, avatar.da_vertices)
    assert torch.equal(avatar.gaussians.vertex_index, distances.argmin(dim=1))


def test_never_to_nothing(avatar):
    with torch.no_grad():
        avatar.gaussians.opacity_logits.fill_(-9.0)
    done = run(avatar, settings=Densification(min_gaussians=10))
    assert done.prune_refused and done.pruned == 0 and done.total == 40


def test_limit_takes_the_largest_gradients_first(avatar):
    densifier = Densifier(Densification(min_gaussians=1, max_gaussians=42, from_body=9.0))
    gradient = torch.arange(40, dtype=torch.float64)[:, None].expand(40, 2) * 1e-3
    densifier.observe(gradient, torch.ones(40, 2), CAMERA)
    before = avatar.gaussians.means.detach().clone()
    done = densifier.step(600, avatar, None)
    assert (done.cloned, done.held_back, done.total) == (2, 37, 42)
    parents = torch.cdist(avatar.gaussians.means[40:], before).argmin(dim=1)
    assert sorted(parents.tolist()) == [38, 39]
    observe(densifier, 42, moving=(0, 1))
    assert densifier.step(800, avatar, None).held_back == 2


def test_not_due_or_nothing_observed_changes_nothing(avatar):
    assert run(avatar, moving=(1,), step=601) is None
    assert run(avatar, moving=(1,), step=400) is None
    assert Densifier().step(600, avatar, None) is None
    assert avatar.gaussians.num_gaussians == 40


def test_one_gaussian(body):
    avatar = Avatar(body, sh_degree=0, refine_pose=False, learn_skinning=False)
    rows = {name: getattr(avatar.gaussians, name)[:1] for name in PARAMETERS}
    avatar.gaussians.replace(rows, torch.zeros(1, dtype=torch.int64))
    done = run(avatar, moving=(0,), settings=Densification(min_gaussians=1, from_body=9.0))
    assert done.total == 2


RATES = dict.fromkeys(("means", "sh0", "sh_rest", "opacity", "scales", "quats", "pose", "skinning"), 1e-3)


def train(avatar, densifier, optimizer, steps, pose):
    for step in steps:
        densifier.step(step, avatar, optimizer, seed=7)
        avatar.prepare(step)
        optimizer.zero_grad()
        cloud = avatar(pose, torch.zeros(3))
        (cloud.means.square().sum() + cloud.covariances.sum() + cloud.colors.sum()).backward()
        optimizer.step()
        densifier.observe(cloud.means.detach()[:, :2] * 1e-5, torch.ones(len(cloud.means), 2), CAMERA)


@pytest.mark.parametrize("stop", [6, 7, 11])
def test_training_through_rounds_resumes_to_the_last_bit(body, stop):
    settings = Densification(
        after_step=0, every=5, before_step=50, min_gaussians=1, from_body=9.0, max_gaussians=90
    )
    pose = make_pose(1)

    def start(seed):
        torch.manual_seed(seed)
        avatar = Avatar(body, sh_degree=1, skinning_every=3)
        return avatar, Densifier(settings), torch.optim.Adam(avatar.parameter_groups(RATES), eps=1e-15)

    through = start(0)
    train(*through, range(14), pose)
    first = start(0)
    train(*first, range(stop), pose)
    saved = copy.deepcopy([part.state_dict() for part in first])
    resumed = start(5)
    for part, state in zip(resumed, saved, strict=True):
        part.load_state_dict(state)
    train(*resumed, range(stop, 14), pose)
    assert through[0].gaussians.num_gaussians > 40
    for (name, a), b in zip(through[0].named_parameters(), resumed[0].parameters(), strict=True):
        assert torch.equal(a, b), name
    assert torch.equal(through[1].gradient_sum, resumed[1].gradient_sum)


@pytest.mark.parametrize("change", [{"gradient": -1.0}, {"every": 0}, {"opacity": float("nan")}])
def test_bad_settings(change):
    with pytest.raises(ConfigError, match="densification"):
        Densification(**change)


def test_bad_loss_scale():
    with pytest.raises(ConfigError, match="loss_scale"):
        Densifier(loss_scale=0.0)


def test_body_of_the_fixture_is_apart_enough():
    """What the tests above rely on: vertices of the random body are more than KL 0.4 apart at 7 mm."""
    distances = torch.cdist(*[Body(make_arrays(), torch.float64).da_vertices()] * 2)
    assert distances.fill_diagonal_(9.0).min() > 0.02
