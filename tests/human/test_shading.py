"""Brightness under a key light: Lambert's law point by point, its mean over the sphere, and an avatar that turns."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck
from torch.testing import assert_close

from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.human import Avatar
from occfusion.human.shading import brightness
from oracles.people import make_pose

LAMP = torch.tensor([0.3, -0.4, 0.2], dtype=torch.float64)
CENTRE = torch.tensor([0.3, -0.5, 4.0], dtype=torch.float64)


def directions(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randn(3, count, generator=generator, dtype=torch.float64)
    return drawn / drawn.norm(dim=0)


def test_lamberts_law_point_by_point() -> None:
    normals = directions(50)
    for column, found in zip(normals.T.tolist(), brightness(3.0 * normals, LAMP).tolist(), strict=True):
        cosine = sum(a * b for a, b in zip(column, LAMP.tolist(), strict=True))
        assert found == pytest.approx(
            (1.0 + max(0.0, cosine)) / (1.0 + math.dist(LAMP, (0, 0, 0)) / 4.0), rel=1e-12
        )


@pytest.mark.parametrize("strength", [0.0, 1e-6, 0.3, 5.0, 1e4])
def test_the_mean_over_all_directions_is_one(strength: float) -> None:
    lamp = strength * LAMP / LAMP.norm()
    # evenly spread: equal areas between heights
    k = torch.arange(20_000, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * k / len(k), k * math.pi * (3 - math.sqrt(5))
    ball = torch.stack([(1 - z * z).sqrt() * angle.cos(), (1 - z * z).sqrt() * angle.sin(), z])
    assert brightness(ball, lamp).mean().item() == pytest.approx(1.0, abs=1e-3)


def test_turning_the_world_changes_nothing() -> None:
    turn = axis_angle_to_matrix(torch.tensor([0.4, -1.0, 0.3], dtype=torch.float64))
    normals = directions(30)
    assert_close(brightness(turn @ normals, turn @ LAMP), brightness(normals, LAMP), atol=1e-12, rtol=0)


def test_gradients_and_a_normal_without_length() -> None:
    normals = directions(7).requires_grad_()
    assert gradcheck(brightness, (normals, LAMP.clone().requires_grad_()))
    flat = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
    found = brightness(flat, LAMP)
    found.sum().backward()
    assert torch.isfinite(found).all() and torch.isfinite(flat.grad).all()


def plain(body, **options):
    avatar = Avatar(body, refine_pose=False, learn_skinning=False, sh_degree=0, **options)
    with torch.no_grad():
        avatar.gaussians.sh0.add_(torch.linspace(0, 0.5, avatar.gaussians.num_gaussians)[:, None, None])
    return avatar


def test_an_avatar_brightens_as_it_turns_to_the_lamp(body) -> None:
    even, lit = plain(body), plain(body, key_light=LAMP)
    pose = make_pose(2, angle=1.0)
    a, b = even(pose, CENTRE), lit(pose, CENTRE)
    assert torch.equal(a.means, b.means) and torch.equal(a.covariances, b.covariances)
    vertices, _ = body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)
    faces = body.faces.numpy()
    rest = body.da_vertices().numpy()
    linear = lit.deform(pose).linear.detach()
    for k in range(0, len(vertices), 7):
        around = faces[(faces == k).any(axis=1)]
        own = np.sum([np.cross(rest[q] - rest[p], rest[r] - rest[p]) for p, q, r in around], axis=0)
        turned = linear[:, :, k].numpy() @ own
        length = np.linalg.norm(turned)
        cosine = float(turned @ LAMP.numpy()) / length if length > 0 else 0.0
        shade = (1 + max(0.0, cosine)) / (1 + 0.25 * float(LAMP.norm()))
        assert_close(b.colors[k], a.colors[k] * shade, atol=1e-12, rtol=1e-9)


def test_a_lamp_of_no_strength_and_the_canonical_view_are_even_light(body) -> None:
    even, dark, lit = plain(body), plain(body, key_light=torch.zeros(3)), plain(body, key_light=LAMP)
    pose = make_pose(1)
    assert torch.equal(even(pose, CENTRE).colors, dark(pose, CENTRE).colors)
    assert torch.equal(even.canonical(CENTRE).colors, lit.canonical(CENTRE).colors)
    assert even.brightness(even.deform(pose)) is None


def test_light_mends_no_pose_and_is_not_learned(body) -> None:
    lit = plain(body, key_light=LAMP)
    pose = make_pose(3)
    pose.body_pose.requires_grad_()
    colors = lit(pose, CENTRE).colors
    (to_sh,) = torch.autograd.grad(colors.sum(), lit.gaussians.sh0, retain_graph=True)
    assert to_sh.abs().min() > 0
    assert torch.autograd.grad(colors.sum(), pose.body_pose, allow_unused=True) == (None,)
    assert "key_light" not in dict(lit.named_parameters())
