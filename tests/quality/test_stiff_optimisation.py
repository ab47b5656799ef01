"""`occfusion stability --optimisation`: Gauss-Newton products against Jacobians, and what the study says."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from made_up_person import made_up_camera
from occfusion.__main__ import main
from occfusion.human import Avatar, Body, PoseSpline
from occfusion.human.rendering import Renderer
from occfusion.settings.stages import OptimSettings, RateSettings
from occfusion.splat import Limits, rasterize
from occfusion.stability.gauss_newton import GaussNewton, ritz_values
from occfusion.stability.scene_condition import (
    BINS,
    Look,
    along_and_across,
    condition,
    in_double,
    mean_blocks,
    moved_by,
    pose_matrix,
    share_of_weakest,
    train,
)  # fmt: skip
from occfusion.stability.toys import adam, handed_over, levenberg_marquardt, own_axes, toys, walk
from occfusion.stages.optim import OptimStage
from occfusion.types import Frame, Pose
from oracles.people import make_arrays

RATES = {"means": 1.6e-4, "pose_turns": 2e-4, "scales": 1e-2, "opacity": 5e-2}
COUNT, SIDE = 4, 9


@pytest.fixture
def small() -> GaussNewton:
    """Four Gaussians in a picture of 9 by 9, through the real rasteriser, in double precision."""
    generator = torch.Generator().manual_seed(0)
    means = (torch.rand(COUNT, 3, generator=generator).double() - 0.5).requires_grad_()
    scales = (torch.rand(COUNT, 3, generator=generator).double() - 2.0).requires_grad_()
    logits = torch.randn(COUNT, generator=generator).double().requires_grad_()
    quats, colors = torch.randn(COUNT, 4, generator=generator), torch.rand(COUNT, 3, generator=generator)
    K = torch.tensor([[9.0, 0, 4.5], [0, 9.0, 4.5], [0, 0, 1]], dtype=torch.float64)
    views = [torch.eye(4).double() for _ in range(2)]
    for view, depth in zip(views, (2.0, 3.0), strict=True):
        view[2, 3] = depth

    def residuals(view: Tensor) -> Tensor:
        drawn = rasterize(
            means, quats.double(), scales.exp(), logits.sigmoid(), colors.double(), view, K, SIDE, SIDE,
            backend="torch", limits=Limits(alpha_min=1e-8, stop=1e-12),
        )  # fmt: skip
        return torch.cat([drawn.rgb, drawn.alpha[..., None]], dim=-1)

    return GaussNewton([lambda view=view: residuals(view) for view in views], [means, scales, logits])


def explicit(matrix: GaussNewton) -> Tensor:
    """The whole matrix from Jacobians that are written out, a row for each residual."""
    rows = []
    for residual in matrix.residuals:
        value = residual().flatten()
        for k in range(len(value)):
            parts = torch.autograd.grad(value[k], list(matrix.parameters), retain_graph=True)
            rows.append(torch.cat([part.flatten() for part in parts]))
    jacobian = torch.stack(rows)
    return jacobian.T @ jacobian


def test_products_are_those_of_the_explicit_jacobian(small: GaussNewton) -> None:
    whole = explicit(small)
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        vectors = [torch.randn(p.shape, generator=generator).double() for p in small.parameters]
        before = [p.detach().clone() for p in small.parameters]
        found = torch.cat([part.flatten() for part in small.product(vectors)])
        wanted = whole @ torch.cat([part.flatten() for part in vectors])
        assert (found - wanted).norm() < 1e-6 * wanted.norm()
        assert all(torch.equal(p.detach(), kept) for p, kept in zip(small.parameters, before, strict=True))
    assert not any(part.any() for part in small.product([torch.zeros_like(p) for p in small.parameters]))
    alone = replace(small, parameters=small.parameters[2:])
    assert torch.allclose(alone.matrix(), whole[-COUNT:, -COUNT:], rtol=1e-6, atol=1e-9)


def test_samples_have_the_matrix_as_their_mean(small: GaussNewton) -> None:
    whole, count = explicit(small), 400
    found = torch.cat([part.flatten(1) for part in small.samples(count)], dim=1)
    mean = found.T @ found / count
    # by Wishart: entries of variance (H_ij^2 + H_ii H_jj) / n
    spread = ((whole.square() + whole.diagonal()[:, None] * whole.diagonal()) / count).sqrt()
    assert ((mean - whole).abs() / spread).max() < 5.0
    assert (mean - whole).abs().max() > 0  # it is a sample, not the matrix


def test_eigenvalues_and_shares_of_directions(small: GaussNewton) -> None:
    wanted = torch.linalg.eigvalsh(explicit(small))
    found, shares = ritz_values(small, 28)
    assert float(found.max()) == pytest.approx(float(wanted.max()), rel=1e-6)
    assert float(shares.sum()) == pytest.approx(1.0)
    # with all steps the shares times the values are the Rayleigh quotient of the first direction
    assert float(found.min()) > -1e-8 * float(found.max())
    short, _ = ritz_values(small, 6)
    assert float(short.max()) == pytest.approx(float(wanted.max()), rel=1e-2)
    few = [float((shares[found < bound * found.max()]).sum()) for bound in (1e-6, 1e-4, 1e-2, 2.0)]
    assert few == sorted(few)


# --- an avatar before a camera ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def look() -> Look:
    avatar = Avatar(
        Body(make_arrays(), torch.float32), sh_degree=0, refine_pose=False, learn_skinning=False, dilation=0.3,
        pose_spline=PoseSpline.over([0, 1, 2], 1),
    )  # fmt: skip
    with torch.no_grad():
        avatar.gaussians.sh0.normal_(generator=torch.Generator().manual_seed(3))
        avatar.gaussians.opacity_logits.fill_(1.0)
    avatar.prepare(0)  # within the bounds of training
    frames = []
    for index, turn in enumerate((0.0, 0.6, 1.2)):
        pose = Pose(
            torch.zeros(10), torch.tensor([torch.pi, 0.0, turn]), torch.zeros(69), torch.tensor([0.0, 0.0, 4.0]), index
        )  # fmt: skip
        camera = made_up_camera(32)
        with torch.no_grad():
            made = Renderer("torch").draw(avatar(pose, camera.centre), camera)
        person = made.alpha > 0.5
        frames.append(
            Frame(index, 0, str(index), made.rgb.clamp(0, 1), person, None, None, None, camera, pose)
        )
    return Look(avatar, frames, Renderer("torch"))


def test_a_picture_knows_less_along_the_line_of_sight(look: Look) -> None:
    along, across = along_and_across(look, look.frames[0], 32)
    seen = across > 1e-2 * across.max()
    assert (across[seen] / along[seen]).median() > 30
    one = mean_blocks(replace(look, frames=look.frames[:1]), 32)
    values = torch.linalg.eigvalsh(mean_blocks(look, 32))
    alone = torch.linalg.eigvalsh(one)
    assert condition(values[seen]).median() < 0.5 * condition(alone[seen]).median()


def test_along_the_line_of_sight_is_what_moving_there_does(look: Look) -> None:
    frame = look.frames[1]
    double = replace(
        look, avatar=in_double(look.avatar, Body(make_arrays(), torch.float64)), renderer=None, frames=[frame]
    )
    samples = 300
    along, across = along_and_across(double, frame, samples)
    chosen = across.topk(3).indices
    means = double.avatar.gaussians.means
    with torch.no_grad():
        carried = double.avatar.deform(frame.pose)
        sight = torch.nn.functional.normalize(carried.means - frame.camera.centre.double(), dim=1)
    for k in chosen.tolist():
        vector = torch.zeros_like(means)
        vector[k] = torch.linalg.solve(
            carried.linear[:, :, k], sight[k]
        )  # the canonical way to where it looks
        (moved,) = GaussNewton(double.residuals(), [means]).product([vector])
        assert float(along[k]) == pytest.approx(float((vector * moved).sum()), rel=5 * (2 / samples) ** 0.5)


def test_the_matrix_of_angles_is_what_turning_them_does(look: Look) -> None:
    double = replace(look, avatar=in_double(look.avatar, Body(make_arrays(), torch.float64)), renderer=None)
    spline, frame = double.avatar.pose_spline, look.frames[1]
    matrix = pose_matrix(double, frame)
    assert double.avatar.pose_spline is spline and matrix.shape == (72, 72)
    residual = replace(double, frames=[frame]).residuals()[0]
    for number in (0, 3, 16 * 3 + 1):
        pictures = []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                assert spline is not None
                spline.turns.zero_()
                spline.turns[:, number // 3, number % 3] = 1e-5 * sign  # all knots alike: the angle itself
                pictures.append(residual())
                spline.turns.zero_()
        change = ((pictures[0] - pictures[1]) / 2e-5).square().sum()
        assert float(matrix[number, number]) == pytest.approx(float(change), rel=1e-5, abs=1e-12)


def test_training_of_the_study_takes_back_what_was_put_in(look: Look) -> None:
    other = replace(look, avatar=in_double(look.avatar, Body(make_arrays(), torch.float64)).float())

    def squares() -> float:
        with torch.no_grad():
            return sum(float(residual().square().mean()) for residual in other.residuals())

    least = squares()
    with torch.no_grad():
        other.avatar.gaussians.sh0.add_(0.5)
    before = squares()
    train(other.avatar, other.frames, Renderer("torch"), {**vars(RateSettings()), "sh0": 2.5e-2}, 40)
    assert least < before and squares() - least < 0.3 * (before - least)


def test_bins_and_shares_of_motion() -> None:
    known = torch.tensor([1.0, 0.5, 0.05, 1e-9])
    found = moved_by("any", known, torch.tensor([3.0, 4.0, 2.0, -7.0]))
    assert found.share == (0.5, 0.25, 0.0, 0.0, 0.25) and len(BINS) == 5
    assert found.distance[0] == pytest.approx(12.5**0.5) and found.distance[4] == 7.0
    blocks = torch.diag_embed(torch.tensor([[3.0, 1.0, 2.0]]).double())
    assert share_of_weakest(blocks, torch.tensor([[3.0, 4.0, 0.0]])) == pytest.approx(16 / 25)


# --- problems with a known optimum -----------------------------------------------------------------------------


@pytest.mark.parametrize("toy", toys(RATES), ids=lambda toy: toy.group)
def test_problems_are_what_they_say(toy) -> None:
    places = torch.tensor(toy.places, dtype=torch.float64)
    count = len(places)
    assert toy.residuals(toy.optimum.expand(count, -1), places).abs().max() < 1e-12
    conditions = toy.condition()
    assert (conditions[1:] > conditions[:-1]).all() and conditions[-1] > 1e3 * conditions[0]
    x, unit = toy.start.expand(count, -1), torch.eye(len(toy.start)).double()
    jacobian = toy.jacobian(x, places)
    for k in range(len(unit)):
        step = 1e-6 * unit[k]
        wanted = (toy.residuals(x + step, places) - toy.residuals(x - step, places)) / 2e-6
        assert torch.allclose(jacobian[..., k], wanted, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("toy", toys(RATES), ids=lambda toy: toy.group)
def test_second_order_steps_do_not_mind_the_condition_and_those_of_adam_do(toy) -> None:
    damped = walk(toy, "LM", None, levenberg_marquardt(toy), 60)
    assert all(one.steps is not None and one.steps <= 20 for one in damped)
    first, last = (walk(replace(toy, places=(p,)), "Adam", toy.rate, adam(toy, toy.rate), 250)[0]
                   for p in (toy.places[0], toy.places[-1]))  # fmt: skip
    assert last.distance > first.distance
    assert last.steps is None or (first.steps is not None and last.steps > 2 * first.steps)


def test_adam_in_the_studies_is_that_of_torch() -> None:
    toy = toys(RATES)[0]
    place = torch.tensor([toy.places[2]], dtype=torch.float64)
    ours, step = toy.start[None], adam(toy, toy.rate)
    theirs = toy.start[None].clone().requires_grad_()
    optimiser = torch.optim.Adam([theirs], lr=toy.rate, eps=1e-15)
    for number in range(1, 80):
        ours = step(ours, place, number)
        optimiser.zero_grad()
        toy.residuals(theirs, place).square().sum().backward()
        optimiser.step()
    assert torch.allclose(ours, theirs, rtol=1e-9, atol=1e-14)


def test_turned_axes_are_own_axes() -> None:
    toy = toys(RATES)[1]
    axes = own_axes(toy)
    jacobian = toy.jacobian(
        toy.start.expand(len(toy.places), -1), torch.tensor(toy.places, dtype=torch.float64)
    )
    turned = axes.transpose(1, 2) @ (jacobian.transpose(1, 2) @ jacobian) @ axes
    off = turned - torch.diag_embed(turned.diagonal(dim1=1, dim2=2))
    assert off.abs().max() < 1e-12


# --- hand-over -------------------------------------------------------------------------------------------------


def test_moments_of_another_scale_stall_and_fresh_ones_do_not() -> None:
    assert handed_over(1.0, fresh=False, steps=1000) < 0.15
    assert handed_over(1e4, fresh=True, steps=1000) < 0.15
    assert handed_over(1e4, fresh=False, steps=1000) > 0.9


def test_a_stage_that_takes_an_avatar_over_moves_at_once() -> None:
    """With the optimisers of the stages themselves: after 100 steps a tenth of the way at least."""
    avatar = Avatar(Body(make_arrays(), torch.float32), sh_degree=0, refine_pose=False, learn_skinning=False)

    def stage() -> torch.optim.Optimizer:
        made = OptimStage(
            avatar, replace(OptimSettings(), densify=False), perceptual=None, densifier=None,
            renderer=Renderer("torch"), seed=0,
        )  # fmt: skip
        return made.configure_optimizers()

    means = avatar.gaussians.means
    for scale in (1e4, 1.0):
        optimiser, before = stage(), means.detach().clone()
        assert not optimiser.state
        rate = next(group["lr"] for group in optimiser.param_groups if group["name"] == "means")
        for _ in range(100):
            optimiser.zero_grad()
            (scale * means.sum()).backward()
            optimiser.step()
        assert ((before - means.detach()) > 0.1 * 100 * rate).all(), scale


# --- the verb --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.stiff
def test_the_quick_study_writes_its_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stability", "--optimisation", "--quick", "--output", str(tmp_path)]) == 0
    assert f"written to {tmp_path}" in capsys.readouterr().out
    page = (tmp_path / "optimisation.md").read_text()
    assert (tmp_path / "optimisation.png").read_bytes()[:4] == b"\x89PNG"
    html = (tmp_path / "optimisation.html").read_text()
    assert 'src="data:' in html and "href=" not in html
    across = re.search(r"across the line of sight / along it \| (\S+) \| (\S+)", page)
    assert across is not None and float(across[2]) > 1e3
    with (tmp_path / "optimisation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["group"] for row in rows} == set(RATES) and len({row["optimiser"] for row in rows}) == 4
    assert "| 1e+04 | 0.000 |" in page
