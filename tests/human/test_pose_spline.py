"""Pose corrections frame by frame: against the recursion that defines B-splines, at the ends, in a fit, in files."""

import dataclasses
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor

from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.human import Avatar, Body, PoseSpline, load_avatar, save_avatar
from occfusion.types import Pose


def basis(k: int, degree: int, t: float) -> float:
    """The k-th B-spline over knots at the whole numbers, by the recursion of Cox and de Boor."""
    if degree == 0:
        return float(k <= t < k + 1)
    left, right = basis(k, degree - 1, t), basis(k + 1, degree - 1, t)
    return ((t - k) * left + (k + degree + 1 - t) * right) / degree


def filled(spline: PoseSpline, seed: int = 0) -> PoseSpline:
    generator = torch.Generator().manual_seed(seed)
    spline = spline.double()
    for parameter in spline.parameters():
        parameter.data = 0.1 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
    return spline


def pose_of(moment: int | None, seed: int = 0) -> Pose:
    generator = torch.Generator().manual_seed(seed)
    angles = 0.3 * torch.randn(75, generator=generator)
    return Pose(torch.zeros(10), angles[:3], angles[3:72], angles[72:], moment)


@pytest.mark.parametrize(
    ("frames", "every"), [(range(100), 4), (range(0, 500, 5), 4), (range(7, 19), 3), ((3, 8), 1)]
)
def test_values_are_those_of_the_recursion(frames: range, every: int) -> None:
    spline = filled(PoseSpline.over(list(frames), every))
    for moment in range(frames[0], frames[-1] + 1):
        t = (moment - spline.first) / spline.spacing + 3.0  # the first three knots lie before the range
        t = min(t, spline.knots - 1e-12)
        weights = [basis(k, 3, t) for k in range(spline.knots)]
        assert sum(weights) == pytest.approx(1.0)
        turns, shift = spline.at(moment)
        for found, knots in ((turns, spline.turns), (shift, spline.places)):
            wanted = sum(
                (w * knot for w, knot in zip(weights, knots, strict=True)), start=torch.zeros_like(found)
            )
            torch.testing.assert_close(found, wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("frames", "every"), [([5], 4), ([5, 6], 100), (list(range(0, 30, 3)), 1), ([0, 9, 10], 2)]
)
def test_range_is_that_of_the_frames(frames: list[int], every: int) -> None:
    spline = filled(PoseSpline.over(frames, every))
    assert all(spline.covers(frame) for frame in frames)
    assert not spline.covers(frames[0] - 1)
    beyond = frames[-1] + int(spline.spacing) + 1
    assert not spline.covers(beyond)
    for outside in (frames[0] - 1, beyond, 10**9):
        assert all(not bool(part.any()) for part in spline.at(outside))


def test_starts_at_no_correction_and_corrections_are_smooth() -> None:
    fresh = PoseSpline.over(range(50), 4)
    assert all(not bool(part.any()) for part in fresh.at(20))
    spline = filled(PoseSpline(0.0, 100.0, 8))
    values = torch.stack([spline.at(frame)[1] for frame in range(501)]).detach()
    second = values.diff(n=2, dim=0)  # a second derivative without jumps: the third differences stay small
    assert float(second.diff(dim=0).abs().max()) < 0.05 * float(second.abs().max())


@pytest.mark.parametrize(("spacing", "knots"), [(0.0, 5), (-1.0, 5), (float("nan"), 5), (1.0, 3)])
def test_impossible_splines_are_refused(spacing: float, knots: int) -> None:
    with pytest.raises(ValueError, match="4 knots"):
        PoseSpline(0.0, spacing, knots)


def test_gradients() -> None:
    spline = filled(PoseSpline.over(range(12), 3))
    rotations = axis_angle_to_matrix(torch.randn(24, 3, dtype=torch.float64))

    def out(turns: Tensor, places: Tensor) -> tuple[Tensor, ...]:
        return torch.func.functional_call(
            spline, {"turns": turns, "places": places}, (7, rotations, torch.zeros(3, dtype=torch.float64))
        )

    assert torch.autograd.gradcheck(out, (spline.turns, spline.places))


def test_avatar_is_posed_as_by_the_corrected_pose(body: Body) -> None:
    spline = PoseSpline.over(range(20), 4)
    with torch.no_grad():
        spline.turns[:] = 0.1 * torch.randn(spline.turns.shape, generator=torch.Generator().manual_seed(1))
        spline.places[:] = torch.tensor([0.1, -0.2, 0.3])
    plain = Avatar(body, refine_pose=False, learn_skinning=False)
    avatar = Avatar(body, refine_pose=False, learn_skinning=False, pose_spline=spline)
    pose, centre = pose_of(6), torch.tensor([0.0, 0.0, -3.0])
    with torch.no_grad():
        # outside the sequence, and for a pose of no sequence, nothing is corrected
        for moment in (None, -1, 20):
            other = dataclasses.replace(pose, frame_index=moment)
            torch.testing.assert_close(
                avatar(other, centre).means, plain(other, centre).means, rtol=0, atol=0
            )
        moved, given = avatar(pose, centre).means, plain(pose, centre).means
        assert float((moved - given).norm(dim=1).median()) > 0.1
        rotations = body.rotations(pose.global_orient, pose.body_pose) @ axis_angle_to_matrix(spline.at(6)[0])
        angles = torch.stack([_axis_angle(rotation) for rotation in rotations])
        corrected = Pose(pose.betas, angles[0], angles[1:].flatten(), pose.transl + spline.places[0])
        torch.testing.assert_close(plain(corrected, centre).means, moved, rtol=1e-4, atol=1e-4)


def _axis_angle(rotation: Tensor) -> Tensor:
    """The inverse of Rodrigues' formula by the matrix logarithm, for angles well under pi."""
    values, vectors = torch.linalg.eig(rotation.double())
    logarithm = (vectors @ torch.diag(values.log()) @ torch.linalg.inv(vectors)).real
    return torch.stack([logarithm[2, 1], logarithm[0, 2], logarithm[1, 0]]).float()


def test_errors_that_wander_are_found_again(body: Body) -> None:
    """Frames of which every third says nothing: their errors are filled in from their neighbours."""
    frames = range(40)
    time = torch.arange(40.0)
    error = 0.05 * torch.sin(time[:, None] * 2 * torch.pi / 25 + torch.arange(72.0)).view(40, 24, 3)
    spline = PoseSpline.over(frames, 4)
    optimiser = torch.optim.Adam(spline.parameters(), lr=2e-3)
    for step in range(600):
        moment = step % 40
        if moment % 3:
            optimiser.zero_grad()
            (spline.at(moment)[0] - error[moment]).square().mean().backward()
            optimiser.step()
    left = torch.stack([spline.at(moment)[0] - error[moment] for moment in frames]).detach()
    silent = [moment for moment in frames if moment % 3 == 0]
    assert float(left[silent].square().mean().sqrt()) < 0.15 * float(error.square().mean().sqrt())


def test_file_keeps_the_spline(body: Body, tmp_path: Path) -> None:
    avatar = Avatar(body, pose_spline=filled(PoseSpline.over(range(0, 50, 5), 4)).float())
    save_avatar(tmp_path / "avatar.safetensors", avatar)
    again = load_avatar(tmp_path / "avatar.safetensors", body)
    assert again.pose_spline is not None and avatar.pose_spline is not None
    assert (again.pose_spline.first, again.pose_spline.spacing) == (0, 15.0)
    for a, b in zip(avatar.pose_spline.at(33), again.pose_spline.at(33), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    save_avatar(tmp_path / "plain.safetensors", Avatar(body))
    assert load_avatar(tmp_path / "plain.safetensors", body).pose_spline is None


def test_rates_reach_the_groups(body: Body) -> None:
    rates = {
        name: 1e-3 for name in ("means", "sh0", "sh_rest", "opacity", "scales", "quats", "pose", "skinning")
    }
    rates |= {"pose_turns": 2e-4, "pose_places": 6e-5}
    groups = {
        group["name"]: group
        for group in Avatar(body, pose_spline=PoseSpline(0, 1, 4)).parameter_groups(rates)
    }
    assert groups["pose_turns"]["lr"] == 2e-4 and groups["pose_places"]["lr"] == 6e-5
    names = [group["name"] for group in Avatar(body).parameter_groups(rates)]
    assert "pose_turns" not in names
    assert all(a != b for a, b in pairwise(sorted(names)))
