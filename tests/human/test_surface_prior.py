"""The terms that close a surface: against loops, by differences, and on Gaussians that only one direction has seen."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from occfusion.geometry.normals import vertex_normals
from occfusion.human import Avatar, Gaussians
from occfusion.human.body import Body
from occfusion.human.observability import UNSURE, Observability, ObservedSurface, canonical_views
from occfusion.human.rendering import Renderer
from occfusion.human.surface_terms import (
    DEPTH_SCALE,
    EXTENT_SCALE,
    INWARDS,
    LONG,
    OUTWARDS,
    THICK,
    TILT_SCALE,
    WIDE,
    KnownSurface,
    depth_and_extent,
    hold,
    tilt,
)
from occfusion.settings.stages import SurfaceSettings
from occfusion.stages.surface import SurfacePrior

BACKENDS = pytest.mark.parametrize("backend", ["torch", "numba"])
ALL = SurfaceSettings(depth=1.0, extent=1.0, outline=1.0, backface=1.0, every=1, tilt=1.0)
NOTHING = SurfaceSettings(depth=0.0, extent=0.0, outline=0.0, backface=0.0, hold=False, tilt=0.0)


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


def prior_of(
    body: Body, settings: SurfaceSettings = ALL, known: Observability | None = None, backend: str = "torch"
) -> SurfacePrior:
    known = known or seen_from_front(body)
    points, faces = body.da_vertices().double().numpy(), body.faces.numpy()
    thickness = np.full(len(points), 0.01)
    views = canonical_views(points, faces, known, thickness, 0.015)
    return SurfacePrior(
        known, vertex_normals(points, faces), thickness, views, settings, renderer=Renderer(backend), seed=0
    )


def behind(prior: SurfacePrior) -> SurfacePrior:
    """Looks from straight behind at every step."""
    prior._views = [prior._views[len(prior._views) // 2]]
    return prior


def test_terms_of_weight_zero_are_not_built(free_body):
    assert prior_of(free_body, NOTHING).terms(avatar_on(free_body), 0) == {}
    some = prior_of(free_body, SurfaceSettings(depth=1.0, extent=0.0, outline=0.0, backface=0.0, tilt=0.0))
    assert set(some.terms(avatar_on(free_body), 0)) == {"surface_depth"}


def test_views_are_asked_at_every_kth_step_with_k_times_the_weight(free_body):
    prior = prior_of(
        free_body, SurfaceSettings(depth=0.0, extent=0.0, outline=0.5, backface=0.25, every=3, tilt=0.0)
    )
    avatar = avatar_on(free_body)
    assert [bool(prior.terms(avatar, step)) for step in range(4)] == [True, False, False, True]
    assert prior.weight("surface_outline") == 1.5 and prior.weight("surface_backface") == 0.75


@BACKENDS
def test_depth_and_extent_against_loops(free_body, backend):
    avatar = avatar_on(free_body)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        avatar.gaussians.means += 0.02 * torch.randn(avatar.gaussians.means.shape, generator=generator)
        avatar.gaussians.raw_quats += 0.5 * torch.randn(avatar.gaussians.raw_quats.shape, generator=generator)
    known = seen_from_front(free_body)
    rng = np.random.default_rng(0)
    axis = rng.standard_normal(known.axis.shape)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    known = Observability(
        known.moments, known.passes, axis, rng.uniform(0, 1, len(axis)), known.unseen, known.is_seen
    )
    terms = prior_of(free_body, ALL, known, backend).terms(avatar, 0)
    gaussians, depth, extent = avatar.gaussians, [], []
    normals = vertex_normals(free_body.da_vertices().double().numpy(), free_body.faces.numpy())
    rotations_scales = gaussians.roots().detach().double().numpy()
    for k in range(0, gaussians.num_gaussians, 7):
        vertex = int(gaussians.vertex_index[k])
        e = axis[vertex]
        # clothes of a centimetre, as far as nobody knows better
        dressed = (
            avatar.da_vertices[vertex].double().numpy()
            + 0.01**2 / (0.01 + UNSURE) * known.ignorance[vertex] * normals[vertex]
        )
        off = float((gaussians.means[k].detach().double().numpy() - dressed) @ e)
        covariance = rotations_scales[k] @ rotations_scales[k].T
        depth.append(known.ignorance[vertex] * (math.hypot(1.0, off / DEPTH_SCALE) - 1.0))
        extent.append(
            known.ignorance[vertex] * (math.hypot(1.0, math.sqrt(e @ covariance @ e) / EXTENT_SCALE) - 1.0)
        )
    # a seventh of them, evenly: the mean of all to within its spread
    assert float(terms["surface_depth"]) == pytest.approx(np.mean(depth), rel=0.05)
    assert float(terms["surface_extent"]) == pytest.approx(np.mean(extent), rel=0.05)


def test_what_is_seen_from_all_round_is_left_alone(free_body):
    known = seen_from_front(free_body, ignorance=0.0)
    avatar = avatar_on(free_body)
    terms = prior_of(free_body, SurfaceSettings(1.0, 1.0, 0.0, 0.0, tilt=0.0), known).terms(avatar, 0)
    assert all(float(term) == 0.0 for term in terms.values())


def test_gaussians_may_begin_off_the_body_where_clothes_are(free_body):
    """They are put off along the normal of their vertex, and are where the depth term costs least."""
    rng = np.random.default_rng(1)
    known = seen_from_front(free_body)
    thickness = rng.uniform(-0.01, 0.08, len(known.ignorance))
    ignorance = rng.uniform(0, 1, len(thickness))
    known = replace(known, ignorance=ignorance)
    surface = ObservedSurface(known, 0.5, 10.0, thickness, 0.005)
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
    known = replace(known, ignorance=np.ones(len(ignorance)))
    points, faces = free_body.da_vertices().double().numpy(), free_body.faces.numpy()
    prior = SurfacePrior(
        known, vertex_normals(points, faces), thickness, [], SurfaceSettings(1.0, 0.0, 0.0, 0.0, tilt=0.0),
        renderer=Renderer("torch"), seed=0,
    )  # fmt: skip
    costs = []
    for share in (0.0, 0.8, 1.0, 1.2):
        heights = share * ObservedSurface(known, 0.5, 10.0, thickness, 0.005).heights
        vertices = Gaussians.on_body(free_body, 0, 0, 0.002, heights)
        avatar = Avatar(free_body, sh_degree=0, refine_pose=False, learn_skinning=False, gaussians=vertices)
        costs.append(float(prior.terms(avatar, 0)["surface_depth"]))
    assert costs[2] == pytest.approx(0.0, abs=1e-9)
    assert min(costs[0], costs[1], costs[3]) > 1e-4 and costs[0] > costs[1]


@BACKENDS
def test_only_what_stands_off_along_the_line_of_sight_is_pulled_back(free_body, backend):
    avatar = avatar_on(free_body)
    with torch.no_grad():
        avatar.gaussians.means += torch.tensor([0.03, 0.02, 0.03])
    prior = prior_of(free_body, SurfaceSettings(1.0, 0.0, 0.0, 0.0, tilt=0.0), backend=backend)
    prior.terms(avatar, 0)["surface_depth"].backward()
    gradient = avatar.gaussians.means.grad
    assert (gradient[:, 2] > 0).float().mean() > 0.9
    assert (gradient[:, :2] == 0).all()


@BACKENDS
def test_gradients_by_differences(free_body, backend):
    avatar = avatar_on(free_body, 0.6)
    prior = behind(prior_of(free_body, backend=backend))
    for name, parameter in (
        ("surface_depth", avatar.gaussians.means),
        ("surface_extent", avatar.gaussians.log_scales),
        ("surface_outline", avatar.gaussians.opacity_logits),
        ("surface_backface", avatar.gaussians.opacity_logits),
    ):
        (gradient,) = torch.autograd.grad(prior.terms(avatar, 0)[name], parameter)
        direction = gradient / gradient.abs().max()  # along which the value changes by more than it rounds
        start, step = parameter.detach().clone(), 1e-3

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
    normals = vertex_normals(free_body.da_vertices().double().numpy(), free_body.faces.numpy())
    is_back = torch.from_numpy(normals[:, 2] < 0)[open_.gaussians.vertex_index]
    with torch.no_grad():
        open_.gaussians.opacity_logits[is_back] = -2.0
    leaking = prior.terms(open_, 0)["surface_backface"]
    assert closed < 0.02 and float(leaking) > 5 * closed
    leaking.backward()
    gradient = open_.gaussians.opacity_logits.grad
    # it closes the back, or thins the front that shines through; most of the gradient does the former
    assert float(gradient[is_back].clamp(max=0).sum()) < 0.0 < float(gradient[~is_back].clamp(min=0).sum())


@BACKENDS
def test_a_needle_and_a_stray_are_brought_back_by_descent(free_body, backend):
    avatar = avatar_on(free_body)
    prior = prior_of(free_body, SurfaceSettings(1.0, 1.0, 0.0, 0.0, tilt=0.0), backend=backend)
    gaussians = avatar.gaussians
    with torch.no_grad():
        gaussians.means[:50, 2] += 0.3
        gaussians.raw_quats[50:100] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        gaussians.log_scales[50:100, 2] = math.log(0.05)
    adam = torch.optim.Adam([gaussians.means, gaussians.log_scales], lr=5e-3, eps=1e-15)
    for step in range(500):
        adam.zero_grad()
        sum(prior.terms(avatar, step).values()).backward()
        adam.step()
    rows = gaussians.vertex_index[:50]
    off = (gaussians.means[:50] - avatar.da_vertices[rows])[:, 2].abs()
    assert float(off.detach().max()) < DEPTH_SCALE
    assert float(gaussians.scales[50:100, 2].detach().max()) < 3 * EXTENT_SCALE


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
        vertices + 0.01 * normals,
        0.02 * thickness,
        axis,
        ignorance,
        0.02 * ignorance.roll(1),
    )
    return KnownSurface(*(value.to(dtype) for value in values))


@pytest.mark.parametrize("threads", [1, 3])
def test_kernels_give_what_they_are_specified_by(free_body, threads):
    """Three costs, all gradients and what is held, of thousands that are off, long and turned; against float64."""

    def terms_of(gaussians, dtype):
        surface, compiled = known_of(free_body, dtype), dtype == torch.float32
        depth, extent = depth_and_extent(gaussians, surface, compiled=compiled)
        return depth, extent, tilt(gaussians, surface, compiled=compiled)

    fast, exact = unruly(free_body).gaussians, unruly(free_body).gaussians.double()
    with torch.no_grad():
        for gaussians in (fast, exact):
            gaussians.log_scales[7] = 3.0  # beyond the bounds of scales: no gradient
            gaussians.log_scales[8] = -20.0
            gaussians.raw_quats[9] = 0.0
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        found = terms_of(fast, torch.float32)
        (0.3 * found[0] + 0.7 * found[1] + 0.5 * found[2]).backward()
        hold(fast, known_of(free_body, torch.float32))
    finally:
        torch.set_num_threads(before)
    expected = terms_of(exact, torch.float64)
    (0.3 * expected[0] + 0.7 * expected[1] + 0.5 * expected[2]).backward()
    hold(exact, known_of(free_body, torch.float64), compiled=False)
    for a, b in zip(found, expected, strict=True):
        assert float(a.detach()) == pytest.approx(float(b.detach()), rel=1e-5)
    for name in ("means", "raw_quats", "log_scales"):
        a, b = getattr(fast, name), getattr(exact, name)
        assert float((a.grad.double() - b.grad).abs().max()) < 1e-5 * float(b.grad.abs().max()), name
        torch.testing.assert_close(a.detach().double(), b.detach(), rtol=1e-5, atol=1e-5)
    assert float(fast.log_scales.grad[7:9].abs().max()) == 0.0 == float(fast.raw_quats.grad[9].abs().max())


def test_what_is_held_is_told_to_whoever_keeps_values(free_body):
    gaussians = unruly(free_body).gaussians
    before = gaussians.means._version, gaussians.log_scales._version
    hold(gaussians, known_of(free_body, torch.float32))
    assert (gaussians.means._version > before[0]) and (gaussians.log_scales._version > before[1])


def test_who_asks_one_term_gets_its_gradient_alone(free_body):
    gradients = []
    for compiled in (True, False):
        gaussians = unruly(free_body).gaussians
        depth_and_extent(gaussians, known_of(free_body, torch.float32), compiled=compiled)[0].backward()
        gradients.append(gaussians)
    fast, plain = gradients
    torch.testing.assert_close(fast.means.grad, plain.means.grad, rtol=1e-4, atol=1e-9)
    for name in ("raw_quats", "log_scales"):
        assert not getattr(fast, name).grad.any() and getattr(plain, name).grad is None


def test_tilt_against_loops(free_body):
    """Of an ellipsoid, its standard deviation along the normal; from the covariance and not from its axes."""
    gaussians, surface = unruly(free_body).gaussians, known_of(free_body, torch.float32)
    roots, costs = gaussians.roots().detach().double().numpy(), []
    for k, vertex in enumerate(gaussians.vertex_index.tolist()):
        normal = surface.normals[vertex].double().numpy()
        out = math.sqrt(normal @ roots[k] @ roots[k].T @ normal)
        costs.append(float(surface.ignorance[vertex]) * (math.hypot(1.0, out / TILT_SCALE) - 1.0))
    for compiled in (True, False):
        found = float(tilt(gaussians, surface, compiled=compiled).detach())
        assert found == pytest.approx(np.mean(costs), rel=1e-4)


def test_tilt_turns_by_its_gradient_and_nothing_else(free_body):
    """In float64 by differences; places and sizes have none, nor has what the video knows from all round."""
    gaussians, surface = unruly(free_body).gaussians.double(), known_of(free_body, torch.float64)
    tilt(gaussians, surface).backward()
    assert gaussians.means.grad is None and gaussians.log_scales.grad is None
    gradient = gaussians.raw_quats.grad
    direction, start, ends = gradient / gradient.norm(), gaussians.raw_quats.detach().clone(), []
    for step in (1e-5, -1e-5):
        with torch.no_grad():
            gaussians.raw_quats.copy_(start + step * direction)
            ends.append(float(tilt(gaussians, surface).detach()))
    assert float(gradient.norm()) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4)
    known = replace(surface, ignorance=torch.zeros_like(surface.ignorance))
    assert float(tilt(gaussians, known).detach()) == 0.0


@pytest.mark.parametrize(
    "quaternion", [[0.0, 0.0, 0.0, 0.0], [1e-30, 0.0, 0.0, 0.0], [1e15, 1e15, 0.0, 1e15]]
)
@pytest.mark.parametrize("compiled", [True, False])
def test_tilt_of_extreme_gaussians_is_finite(free_body, quaternion, compiled):
    gaussians = avatar_on(free_body).gaussians
    with torch.no_grad():
        gaussians.raw_quats[:50] = torch.tensor(quaternion)
        gaussians.log_scales[50:100], gaussians.log_scales[100:150] = 80.0, -80.0
    found = tilt(gaussians, known_of(free_body, torch.float32), compiled=compiled)
    found.backward()
    assert torch.isfinite(found) and torch.isfinite(gaussians.raw_quats.grad).all()


def test_feathers_lie_down_by_descent_and_stay_as_large(free_body):
    avatar = avatar_on(free_body)
    gaussians, prior = avatar.gaussians, prior_of(free_body, replace(NOTHING, tilt=1.0))
    with torch.no_grad():
        gaussians.log_scales[:, 0] = math.log(0.02)
        generator = torch.Generator().manual_seed(0)
        gaussians.raw_quats += 0.3 * torch.randn(gaussians.raw_quats.shape, generator=generator)
    sizes = gaussians.log_scales.detach().clone()
    adam = torch.optim.Adam([gaussians.raw_quats], lr=1e-2, eps=1e-15)
    costs = []
    for step in range(150):
        adam.zero_grad()
        (term,) = prior.terms(avatar, step).values()
        term.backward()
        adam.step()
        costs.append(float(term.detach()))
    assert costs[0] > 3.0 and costs[-1] < 0.2 * costs[0]
    assert torch.equal(gaussians.log_scales.detach(), sizes)


def test_penalties_of_tensors_alone_are_those_of_the_avatar(free_body):
    """What a GPU records of a step reads nothing else."""
    prior, avatar = prior_of(free_body, ALL, backend="torch"), unruly(free_body)
    gaussians, surface = avatar.gaussians, prior._surface(avatar)
    wanted = prior._penalties(gaussians, surface)
    found = prior._penalties_by_tensors(*gaussians.tensors(), *vars(surface).values())
    assert len(found) == len(prior._penalty_names()) == 3
    for ours, theirs in zip(found, wanted, strict=True):
        assert torch.equal(ours, theirs)
        both = [
            torch.autograd.grad(value, list(gaussians.parameters()), allow_unused=True)
            for value in (ours, theirs)
        ]
        for a, b in zip(*both, strict=True):
            assert (a is None) == (b is None) and (a is None or torch.equal(a, b))
