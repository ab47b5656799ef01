"""The terms that close a surface: against loops, by differences, and on Gaussians that only one direction has seen."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from occfusion.geometry.camera import camera_round, orbit_camera
from occfusion.geometry.coverage import surface_frames
from occfusion.geometry.normals import vertex_normals
from occfusion.human import Avatar, Gaussians
from occfusion.human.body import Body
from occfusion.human.observability import UNSURE, Observability, ObservedSurface
from occfusion.human.rendering import Renderer
from occfusion.human.surface_bounds import (
    INWARDS,
    LONG,
    OUTWARDS,
    THICK,
    WIDE,
    KnownSurface,
    hold,
)
from occfusion.human.virtual_views import VirtualView, virtual_view
from occfusion.settings.stages import SurfaceSettings
from occfusion.stages.surface import SurfacePrior

BACKENDS = pytest.mark.parametrize("backend", ["torch", "numba"])
ALL = SurfaceSettings(outline=1.0, backface=1.0, every=1)
NOTHING = SurfaceSettings(outline=0.0, backface=0.0, hold=False)


class Views(Sequence[VirtualView]):
    """From so many sides evenly round the body in the canonical pose, drawn when they are asked for."""

    def __init__(self, count: int, draw: Callable[[float], VirtualView]) -> None:
        self.count, self.draw = count, cache(draw)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, number):
        if isinstance(number, slice):
            return [self[k] for k in range(*number.indices(self.count))]
        return self.draw(2.0 * math.pi * number / self.count)


def seen_from_front(body: Body, ignorance: float = 1.0) -> Observability:
    """The front of a body, seen from straight before; the back by nobody."""
    points, faces = body.da_vertices().double().numpy(), body.faces.numpy()
    along = np.zeros((len(points), 3, 3))
    along[:, 2, 2] = 1.0
    is_seen = vertex_normals(points, faces)[:, 2] > 0
    axis = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return Observability(along, along, axis, np.full(len(points), ignorance), 1.0 - is_seen, is_seen)


def avatar_on(body: Body, opacity: float = 0.95) -> Avatar:
    avatar = Avatar(
        body, sh_degree=0, refine_pose=False, learn_skinning=False,
        gaussians=Gaussians.on_body(body, 0, 20_000, 0.002),
    )  # fmt: skip
    with torch.no_grad():
        avatar.gaussians.opacity_logits.fill_(math.log(opacity / (1 - opacity)))
    return avatar


def facing_away(avatar: Avatar) -> torch.Tensor:
    """Gaussians of the back, bool `[N]`."""
    normals = vertex_normals(avatar.da_vertices.double().numpy(), avatar.body.faces.numpy())
    return torch.from_numpy(normals[:, 2] < 0)[avatar.gaussians.vertex_index]


def prior_of(
    body: Body,
    settings: SurfaceSettings = ALL,
    known: Observability | None = None,
    backend: str = "torch",
) -> SurfacePrior:
    known = known or seen_from_front(body)
    points, faces = body.da_vertices().double().numpy(), body.faces.numpy()
    thickness, frames = np.full(len(points), 0.01), surface_frames(points, faces)
    pose, middle, up = body.da_pose(), torch.from_numpy(points.mean(axis=0)), torch.tensor([0.0, 1.0, 0.0])
    before = orbit_camera(middle, 0.0, 3.0, 0.75, 160)

    def draw(angle: float) -> VirtualView:
        camera = camera_round(before, middle, up, angle)
        return virtual_view(points, frames, faces, known, thickness, camera, pose)

    return SurfacePrior(
        known,
        vertex_normals(points, faces),
        thickness,
        Views(24, draw),
        settings,
        renderer=Renderer(backend),
        seed=0,
    )


def behind(prior: SurfacePrior) -> SurfacePrior:
    """Looks from straight behind at every step."""
    return looking(prior, 0.5)


def looking(prior: SurfacePrior, turn: float) -> SurfacePrior:
    """Looks from so many turns round the person at every step."""
    prior._views = [prior._views[int(len(prior._views) * turn)]]
    return prior


def test_terms_of_weight_zero_are_not_built(free_body):
    assert prior_of(free_body, NOTHING).terms(avatar_on(free_body), 0) == {}
    for name in ("outline", "backface"):
        some = prior_of(free_body, replace(NOTHING, **{name: 1.0}))
        assert set(some.terms(avatar_on(free_body), 0)) == {f"surface_{name}"}


def test_views_are_asked_at_every_kth_step_with_k_times_the_weight(free_body):
    prior = prior_of(free_body, SurfaceSettings(outline=0.5, backface=0.25, every=3))
    avatar = avatar_on(free_body)
    assert [bool(prior.terms(avatar, step)) for step in range(4)] == [True, False, False, True]
    assert prior.weight("surface_outline") == 1.5 and prior.weight("surface_backface") == 0.75


def test_what_is_seen_from_all_round_is_left_alone(free_body):
    avatar, known = avatar_on(free_body), seen_from_front(free_body)
    all_round = np.tile(np.eye(3) / 3, (len(known.ignorance), 1, 1))
    turned = replace(known, passes=all_round, unseen=np.zeros_like(known.unseen))
    found = []
    for each in (known, turned):
        prior = looking(prior_of(free_body, known=each), 0.25)
        found.append(prior.terms(avatar, 0))
    assert float(found[1]["surface_outline"].detach()) < 0.05 * float(found[0]["surface_outline"].detach())
    assert float(found[1]["surface_backface"].detach()) == 0.0 < float(found[0]["surface_backface"].detach())


def test_gaussians_may_begin_off_the_body_where_clothes_are(free_body):
    """They are put off along the normal of their vertex."""
    rng = np.random.default_rng(1)
    known = seen_from_front(free_body)
    thickness = rng.uniform(-0.01, 0.08, len(known.ignorance))
    ignorance = rng.uniform(0, 1, len(thickness))
    known = replace(known, ignorance=ignorance)
    surface = ObservedSurface(known, 0.5, 10.0, thickness)
    plain = Gaussians.on_body(free_body, 0, 20_000, 0.002)
    dressed = Gaussians.on_body(free_body, 0, 20_000, 0.002, surface.heights)
    normals = vertex_normals(free_body.da_vertices().double().numpy(), free_body.faces.numpy())
    moved = (dressed.means - plain.means).detach().double().numpy()
    for k in range(0, len(moved), 501):
        vertex = int(plain.vertex_index[k])
        worn = max(thickness[vertex], 0.0)
        expected = worn**2 / (worn + UNSURE) * ignorance[vertex] * normals[vertex]
        assert moved[k] == pytest.approx(expected, abs=1e-6)
    assert torch.equal(dressed.raw_quats, plain.raw_quats) and torch.equal(
        dressed.vertex_index, plain.vertex_index
    )
    assert surface.heights.max() > 0.05 and (surface.heights >= 0).all()


@BACKENDS
def test_gradients_by_differences(free_body, backend):
    avatar, prior = avatar_on(free_body, 0.6), behind(prior_of(free_body, backend=backend))
    for name, parameter in (
        ("surface_outline", avatar.gaussians.means),
        ("surface_outline", avatar.gaussians.log_scales),
        ("surface_outline", avatar.gaussians.opacity_logits),
        ("surface_backface", avatar.gaussians.opacity_logits),
    ):
        (gradient,) = torch.autograd.grad(prior.terms(avatar, 0)[name], parameter)
        direction = gradient / gradient.abs().max()  # along which the value changes by more than it rounds
        start, step = parameter.detach().clone(), 1e-4  # few splats gain or lose a pixel

        ends = []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                parameter.copy_(start + sign * step * direction)
                ends.append(float(prior.terms(avatar, 0)[name].double()))
                parameter.copy_(start)
        expected = (ends[0] - ends[1]) / (2 * step)
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=0.05, abs=1e-5), name


def test_the_front_does_not_shine_through_a_closed_back(free_body):
    prior = behind(prior_of(free_body))
    closed = float(prior.terms(avatar_on(free_body, 0.99), 0)["surface_backface"])
    open_ = avatar_on(free_body, 0.99)
    is_back = facing_away(open_)
    with torch.no_grad():
        open_.gaussians.opacity_logits[is_back] = -2.0
    leaking = prior.terms(open_, 0)["surface_backface"]
    assert closed < 0.02 and float(leaking) > 5 * closed
    leaking.backward()
    gradient = open_.gaussians.opacity_logits.grad
    # it closes the back, or thins the front that shines through; most of the gradient does the former
    assert float(gradient[is_back].clamp(max=0).sum()) < 0.0 < float(gradient[~is_back].clamp(min=0).sum())


@BACKENDS
@pytest.mark.slow
def test_strays_are_brought_back_and_holes_closed_by_descent(free_body, backend):
    """The outline becomes that of the dressed body, a centimetre off it, from all sides."""
    avatar, prior = (
        avatar_on(free_body),
        prior_of(free_body, replace(NOTHING, outline=1.0, every=1), backend=backend),
    )
    gaussians = avatar.gaussians
    with torch.no_grad():
        gaussians.means[:400] += torch.tensor([0.0, 0.0, 0.1])
        gaussians.opacity_logits[2000:2600] = -4.0

    def off() -> list[float]:
        renderer, found = Renderer(backend), []
        with torch.no_grad():
            for view in prior._views[::5]:
                alpha = view.alpha.float() / 255.0
                drawn = renderer.canonical_alpha(avatar, view.camera)
                found.append(float((view.weight / 255.0 * (drawn - alpha).square()).sum() / alpha.sum()))
        return found

    before = off()
    adam = torch.optim.Adam(
        [{"params": [gaussians.means], "lr": 1e-3}, {"params": [gaussians.opacity_logits], "lr": 0.1}],
        eps=1e-15,
    )
    for step in range(120):
        adam.zero_grad()
        sum(prior.terms(avatar, step).values()).backward()
        adam.step()
    after = off()
    assert max(after) < 0.35 * max(before) and all(a < b for a, b in zip(after, before, strict=True))


@BACKENDS
def test_extreme_gaussians_have_finite_gradients(free_body, backend):
    avatar = avatar_on(free_body)
    with torch.no_grad():
        avatar.gaussians.means[0] = 1e3
        avatar.gaussians.log_scales[1] = 10.0
        avatar.gaussians.log_scales[2] = -60.0
        avatar.gaussians.raw_quats[3] = 1e-20
        avatar.gaussians.opacity_logits[4] = 80.0
    total = sum(prior_of(free_body, backend=backend).terms(avatar, 0).values())
    total.backward()
    assert math.isfinite(float(total.detach()))
    for parameter in avatar.gaussians.parameters():
        assert parameter.grad is None or bool(parameter.grad.isfinite().all())


def test_the_same_seed_and_step_take_the_same_view(free_body):
    prior, avatar = prior_of(free_body), avatar_on(free_body)
    first = [float(prior.terms(avatar, step)["surface_outline"]) for step in range(4)]
    assert first == [float(prior.terms(avatar, step)["surface_outline"]) for step in range(4)]
    assert len(set(first)) > 1


def unruly(body: Body) -> Avatar:
    """Gaussians off the body in all directions, long and turned at will."""
    avatar, generator = avatar_on(body), torch.Generator().manual_seed(3)
    gaussians = avatar.gaussians
    with torch.no_grad():
        gaussians.means += 0.1 * torch.randn(gaussians.means.shape, generator=generator)
        gaussians.raw_quats += torch.randn(gaussians.raw_quats.shape, generator=generator)
        gaussians.log_scales += torch.randn(gaussians.log_scales.shape, generator=generator)
    return avatar


@BACKENDS
def test_nothing_leaves_the_room_that_ignorance_gives(free_body, backend):
    avatar, prior = unruly(free_body), prior_of(free_body, backend=backend)
    prior.hold(avatar)
    gaussians, rows = avatar.gaussians, avatar.gaussians.vertex_index
    points, faces = free_body.da_vertices().double().numpy(), free_body.faces.numpy()
    normals = torch.from_numpy(vertex_normals(points, faces)).float()[rows]
    height = ((gaussians.means - avatar.da_vertices[rows]) * normals).sum(dim=1)
    assert float(height.max()) <= 0.01 + OUTWARDS + 1e-5 and float(height.min()) >= -INWARDS - 1e-5
    # each axis of a Gaussian stays within its bound, so that the whole stays within the root of three of it
    for direction, bound in ((normals, THICK), (torch.tensor([0.0, 0.0, 1.0]).expand_as(normals), LONG)):
        along = (gaussians.roots() * direction[:, :, None]).sum(dim=1)
        assert float(along.abs().max()) <= bound + 1e-5
    # nor wider than a share of what its neighbours over the clothes are apart
    dressed = points + 0.01 * vertex_normals(points, faces)
    apart = cKDTree(dressed).query(dressed, k=4)[0][:, 1:]
    widest = torch.from_numpy(WIDE * np.sqrt((apart**2).mean(axis=1))).float()[rows]
    share = gaussians.scales.max(dim=1).values / widest
    assert float(share.max()) == pytest.approx(1.0, abs=1e-3)


@BACKENDS
def test_holding_twice_is_holding_once_and_what_is_inside_stays(free_body, backend):
    avatar, prior = unruly(free_body), prior_of(free_body, backend=backend)
    prior.hold(avatar)
    once = {name: value.clone() for name, value in avatar.gaussians.state_dict().items()}
    prior.hold(avatar)
    for name, value in avatar.gaussians.state_dict().items():
        torch.testing.assert_close(value, once[name], rtol=0, atol=1e-6)
    flat = avatar_on(free_body)
    with torch.no_grad():
        flat.gaussians.log_scales.clamp_(max=math.log(0.004))
    before = flat.gaussians.means.clone()
    prior.hold(flat)
    torch.testing.assert_close(flat.gaussians.means, before)


@pytest.mark.parametrize("ignorance", [0.0, 0.1])
def test_who_was_seen_from_all_round_is_not_held(free_body, ignorance):
    avatar = unruly(free_body)
    before = {name: value.clone() for name, value in avatar.gaussians.state_dict().items()}
    prior_of(free_body, known=seen_from_front(free_body, ignorance)).hold(avatar)
    for name, value in avatar.gaussians.state_dict().items():
        assert torch.equal(value, before[name])


def known_of(body: Body, dtype: torch.dtype) -> KnownSurface:
    """All kinds of places of a body, known more and less."""
    generator = torch.Generator().manual_seed(4)
    count = len(body.da_vertices())
    normals, axis = (
        torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1) for _ in range(2)
    )
    thickness, ignorance = (torch.rand(count, generator=generator) for _ in range(2))
    vertices = body.da_vertices()
    values = (
        vertices,
        normals,
        0.02 * thickness,
        axis,
        ignorance,
        0.02 * ignorance.roll(1),
    )
    return KnownSurface(*(value.to(dtype) for value in values))


@pytest.mark.parametrize("threads", [1, 3])
def test_the_kernel_holds_as_it_is_specified(free_body, threads):
    """Thousands that are off, long and turned, some beyond all bounds; against float64."""
    fast, exact = unruly(free_body).gaussians, unruly(free_body).gaussians.double()
    with torch.no_grad():
        for gaussians in (fast, exact):
            gaussians.log_scales[7] = 3.0
            gaussians.log_scales[8] = -20.0
            gaussians.raw_quats[9] = 0.0
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        hold(fast, known_of(free_body, torch.float32))
    finally:
        torch.set_num_threads(before)
    hold(exact, known_of(free_body, torch.float64), compiled=False)
    for name in ("means", "raw_quats", "log_scales"):
        a, b = getattr(fast, name).detach(), getattr(exact, name).detach()
        torch.testing.assert_close(a.double(), b, rtol=1e-5, atol=1e-5)


def test_what_is_held_is_told_to_whoever_keeps_values(free_body):
    gaussians = unruly(free_body).gaussians
    before = gaussians.means._version, gaussians.log_scales._version
    hold(gaussians, known_of(free_body, torch.float32))
    assert (gaussians.means._version > before[0]) and (gaussians.log_scales._version > before[1])
