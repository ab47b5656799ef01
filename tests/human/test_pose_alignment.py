"""Poses aligned with outlines: derivatives, the linear system, what is recovered, and what is left alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.stats import multivariate_normal

from occfusion.geometry.camera import project_vertices
from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.geometry.zbuffer import rasterize_mesh
from occfusion.human import Avatar, Body, PoseSpline, embedded_body, load_avatar, save_avatar
from occfusion.human.posed_mesh import mesh_poser
from occfusion.observation import aligner as aligner_module
from occfusion.observation import sequence_alignment
from occfusion.observation.aligner import Aligner, spline_weights
from occfusion.observation.aligner import align_poses as align_with
from occfusion.observation.knot_spacing import frames_a_knot, likely_spacing, window
from occfusion.observation.outline_system import OutlineSystem
from occfusion.observation.pose_alignment import GROUPS, WORTH, Alignment, aligned_pose
from occfusion.observation.pose_witness import (
    Look,
    Witness,
    _spread,
    misfits,
    observe_outline,
)
from occfusion.observation.sequence_alignment import (
    align_sequence,
    pieces,
    pilot_positions,
    positions_looked_at,
)
from occfusion.synth.disturb import move_edge
from occfusion.types import Camera, Frame, Pose

SIZE, FRAMES = 112, 32
Floats = np.ndarray


@pytest.fixture(scope="module")
def whole_body() -> Body:
    return embedded_body()


def camera() -> Camera:
    K = torch.tensor([[120.0, 0.0, 56.0], [0.0, 120.0, 56.0], [0.0, 0.0, 1.0]])
    viewmat = torch.tensor(
        [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, 2.6], [0.0, 0.0, 0.0, 1.0]]
    )
    return Camera(viewmat, K, SIZE, SIZE)


def motion(frame: float) -> Pose:
    """Somebody who turns round and moves arms and legs."""
    turns = torch.zeros(24, 3)
    turns[0, 1] = 0.2 * frame
    turns[1, 0], turns[2, 0] = 0.3 * np.sin(0.4 * frame), -0.3 * np.sin(0.4 * frame)
    turns[16, 2], turns[17, 2] = -0.6 + 0.2 * np.sin(0.3 * frame), 0.6 + 0.2 * np.cos(0.3 * frame)
    turns[18, 1], turns[19, 1] = -0.4, 0.4
    return Pose(torch.zeros(10), turns[0], turns[1:].reshape(-1), torch.zeros(3), frame)


def mask_of(body: Body, pose: Pose) -> Floats:
    vertices, _ = body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)
    own = camera()
    pixels, depth = project_vertices(
        vertices.double().numpy(), own.viewmat.double().numpy(), own.K.double().numpy()
    )
    seen = rasterize_mesh(4 * pixels, depth, body.faces.numpy(), 4 * SIZE, 4 * SIZE).face >= 0
    return seen.reshape(SIZE, 4, SIZE, 4).mean(axis=(1, 3)) > 0.5


def looks(
    body: Body, given: Callable[[int], Pose], true: Callable[[int], Pose], hide: slice | None = None
) -> list[Look]:
    found = []
    for k in range(FRAMES):
        mask = mask_of(body, true(k))
        if hide is not None and k < 0.8 * FRAMES:
            mask[:, hide] = False
        found.append(Look(k, given(k), camera(), mask))
    return found


def wander(found: list[Look], pixels: float) -> list[Look]:
    """The edges of masks off by so much, alike for some pixels and for some frames, as a segmenter's are."""
    noise = np.random.default_rng(3).standard_normal((FRAMES, SIZE, SIZE))
    shifts = gaussian_filter(noise, 3.0)
    shifts *= pixels / shifts.std()
    return [
        replace(look, seen=move_edge(look.seen, shift.astype(np.float32)))
        for look, shift in zip(found, shifts, strict=True)
    ]


def joints_of(body: Body, pose: Pose) -> Floats:
    return body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)[1].double().numpy()[:22]


def off(body: Body, found: list[Pose], true: Callable[[int], Pose]) -> tuple[float, float]:
    """Root mean square distances of joints across and along the line of sight, millimetres."""
    each = np.stack([joints_of(body, p) - joints_of(body, true(k)) for k, p in enumerate(found)])
    across, along = each[..., :2], each[..., 2]
    return 1000 * float(np.sqrt((across**2).sum(-1).mean())), 1000 * float(np.sqrt((along**2).mean()))


def wrong(spread: float, place: float = 0.0, every: int = 6) -> Callable[[int], Pose]:
    """The motion with errors that are smooth in time; with a knot a frame, next to independent from frame to frame."""
    spline = PoseSpline.over(range(FRAMES), every)
    generator = torch.Generator().manual_seed(5)
    spline.turns.data = spread * torch.randn(spline.turns.shape, generator=generator)
    spline.places.data = place * torch.randn(spline.places.shape, generator=generator)
    body = embedded_body()
    return lambda k: aligned_pose(motion(k), spline, body)


def test_derivatives_are_those_of_the_body(whole_body: Body) -> None:
    """Central differences of the body's own forward pass, in float64, by turns from the right, place and shape."""
    body = embedded_body(torch.float64)
    pose = motion(7)
    turns = 0.05 * torch.randn(24, 3, dtype=torch.float64)
    poser = mesh_poser(body)
    mesh = poser.pose(pose, turns.numpy(), np.zeros(3))
    chosen = np.arange(0, body.num_vertices, 97)
    axes = [poser.derivatives(mesh, chosen, np.tile(axis, (len(chosen), 1))) for axis in np.eye(3)]
    by_turns, by_shape = (np.stack(parts, axis=-1) for parts in zip(*axes, strict=True))

    def vertices(extra: torch.Tensor, betas: torch.Tensor) -> Floats:
        given = body.rotations(pose.global_orient, pose.body_pose) @ axis_angle_to_matrix(turns)
        moved = replace(pose, betas=betas, frame_index=0.0)
        spline = PoseSpline(0.0, 1.0, 4).double()
        spline.turns.data[:] = 0.0
        rotations = given @ axis_angle_to_matrix(extra)
        from occfusion.geometry.skinning import blend, bone_transforms, skin_points

        rest = body.rest(moved.betas)
        transforms = bone_transforms(rotations, rest.joints, body.parents)
        points = rest.vertices + body.pose_offsets(rotations)
        return skin_points(points, blend(body.weights, transforms))[chosen].numpy()

    nothing, step = torch.zeros(24, 3, dtype=torch.float64), 1e-5
    betas = torch.zeros(10, dtype=torch.float64)
    np.testing.assert_allclose(mesh.vertices[chosen], vertices(nothing, betas), atol=1e-7)
    for joint, axis in ((0, 1), (3, 0), (4, 2), (16, 1), (19, 0)):
        ahead, behind = nothing.clone(), nothing.clone()
        ahead[joint, axis], behind[joint, axis] = step, -step
        wanted = (vertices(ahead, betas) - vertices(behind, betas)) / (2 * step)
        np.testing.assert_allclose(by_turns[:, 3 * joint + axis], wanted, atol=1e-7)
    for component in (0, 4):
        ahead = betas.clone()
        ahead[component] = step
        wanted = (vertices(nothing, ahead) - vertices(nothing, -ahead)) / (2 * step)
        np.testing.assert_allclose(by_shape[:, component], wanted, atol=1e-7)


def test_outlines_move_as_the_derivatives_say(whole_body: Body) -> None:
    """A mask of a body that is 1 cm to the side and has an arm turned lies as far off as predicted."""
    given, spline = motion(3), PoseSpline(0.0, 10.0, 4)
    spline.turns.data[:, 16, 2] = 0.06
    spline.places.data[:, 0] = 0.01
    mask = mask_of(whole_body, aligned_pose(given, spline, whole_body))
    nothing = np.zeros((24, 3)), np.zeros(3)
    found = observe_outline(whole_body, Look(3, given, camera(), mask), nothing, 0.06)
    assert found is not None and len(found.offsets) > 100
    unknowns = np.zeros(75)
    unknowns[3 * 16 + 2], unknowns[72] = 0.06, 0.01
    predicted = found.turns @ unknowns
    assert np.abs(predicted).max() > 0.8
    # each point is as far off as a binary mask is a staircase, and all together are not
    assert np.median(np.abs(found.offsets - predicted)) < 0.2
    assert np.corrcoef(found.offsets, predicted)[0, 1] > 0.85
    slope = (predicted * found.offsets).sum() / (predicted**2).sum()
    assert slope == pytest.approx(1.0, abs=0.07)


def test_a_large_picture_is_looked_at_smaller(whole_body: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    """An outline in it is where it is in the whole one, in its own pixels; a small one is taken as it is."""
    given = motion(3)
    moved = replace(given, transl=torch.tensor([0.02, 0.0, 0.0]))
    mask = torch.from_numpy(mask_of(whole_body, moved))
    frame = Frame(3, 0, "f", torch.zeros(SIZE, SIZE, 3), mask, None, None, None, camera(), given)
    whole = Look.at(frame)
    assert whole.pixel == 1.0 and whole.camera is frame.camera
    monkeypatch.setattr("occfusion.observation.pose_witness.LARGEST", 70)
    small = Look.at(frame)
    assert small.pixel == pytest.approx(1.6) and small.seen.shape == (70, 70)
    nothing = np.zeros((24, 3)), np.zeros(3)
    mean = []
    for look in (whole, small):
        found = observe_outline(whole_body, look, nothing, 0.06)
        assert found is not None
        sideways = np.abs(found.turns[:, 72]) > 0.9 * found.per_metre
        mean.append(np.median(found.offsets[sideways] / found.turns[sideways, 72]))
    assert mean[0] == pytest.approx(0.02, abs=0.003) and mean[1] == pytest.approx(0.02, abs=0.003)


def test_knots_weigh_as_the_spline_does() -> None:
    spline = PoseSpline.over(range(20), 4)
    spline.places.data = torch.randn(spline.places.shape)
    for frame in (0, 3, 11, 19):
        wanted = spline.at(frame)[1].detach().numpy()
        np.testing.assert_allclose(
            spline_weights(spline, frame) @ spline.places.detach().numpy(), wanted, atol=1e-6
        )


@pytest.mark.parametrize("every", [8, 2])  # two links of the chain and three
def test_the_system_is_solved_as_stacked_least_squares(
    every: int, whole_body: Body, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against rows one below the other with the prior as further rows, by a solver for such; and the variances."""
    monkeypatch.setattr(aligner_module, "PATCHES", 12)
    aligner = Aligner(
        looks(whole_body, motion, wrong(0.03))[:12], whole_body, PoseSpline.over(range(12), every)
    )
    seen = [
        (k, w)
        for k, look in enumerate(aligner._looks)
        if (w := observe_outline(whole_body, look, aligner.correction(k), 0.08))
    ]
    system = OutlineSystem(seen, aligner._weights, aligner._patch, aligner.values, False)
    system.weigh()
    rng = np.random.default_rng(0)
    precision = np.concatenate([rng.uniform(1e2, 1e4, system.count), system.fixed_precision])
    solution, variance = system.solve_with_variance(precision)
    np.testing.assert_array_equal(system.solve(precision), solution)

    def row_of(k: int, w: Witness) -> np.ndarray:
        place = w.per_metre[:, None] * (aligner._patch[w.vertices][:, None] == np.arange(12))
        knots = np.kron(aligner._weights[k], w.turns)
        return np.concatenate([knots, w.picture, w.shape, w.per_metre[:, None], place], axis=1)

    rows = np.concatenate([row_of(k, w) for k, w in seen])
    root = np.sqrt(system.row_weights)
    stacked = np.concatenate([rows * root[:, None], np.diag(np.sqrt(precision))])
    targets = np.concatenate([np.concatenate([w.offsets for _, w in seen]) * root, np.zeros(len(precision))])
    wanted = np.linalg.lstsq(stacked, targets, rcond=None)[0]
    np.testing.assert_allclose(solution, wanted, atol=1e-6 * np.abs(wanted).max())
    hessian = stacked.T @ stacked
    np.testing.assert_allclose(variance, np.diag(np.linalg.inv(hessian)), rtol=1e-5)
    # with what follows the knots expected to be what was found, knots are the same, and surer if that is certain
    found = solution[system.count :]
    for variances, matrix in (
        (np.full_like(found, 1e-14), hessian[: system.count, : system.count]),
        (None, hessian),
    ):
        loose = 1.0 / system.fixed_precision
        expected = (
            found if variances is not None else np.zeros_like(found),
            loose if variances is None else variances,
        )
        other = OutlineSystem(seen, aligner._weights, aligner._patch, aligner.values, False, expected)
        other.weigh_as(system)
        own = np.concatenate([precision[: system.count], other.fixed_precision])
        knots, spread = (part[: system.count] for part in other.solve_with_variance(own))
        np.testing.assert_allclose(knots, solution[: system.count], atol=1e-6 * np.abs(wanted).max())
        np.testing.assert_allclose(spread, np.diag(np.linalg.inv(matrix))[: system.count], rtol=1e-5)


def test_evidence_is_how_likely_what_is_seen_is(whole_body: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two priors' difference, against the densities of what both say of the outlines together, as a dense normal."""
    monkeypatch.setattr(aligner_module, "PATCHES", 6)
    aligner = Aligner(looks(whole_body, motion, wrong(0.03))[:4], whole_body, PoseSpline.over(range(4), 2))
    seen = [(k, witness.only(slice(None, None, 9))) for k, witness in aligner.observe(range(4), 0.08)]
    system = OutlineSystem(seen, aligner._weights, aligner._patch, aligner.values, False)
    system.weigh()
    system.row_weights = np.maximum(system.row_weights, 0.1)  # a row that counts nothing has no density
    system._assemble()
    patches = int(aligner._patch.max()) + 1

    def row_of(k: int, w: Witness) -> np.ndarray:
        place = w.per_metre[:, None] * (aligner._patch[w.vertices][:, None] == np.arange(patches))
        knots = np.kron(aligner._weights[k], w.turns)
        return np.concatenate([knots, w.picture, w.shape, w.per_metre[:, None], place], axis=1)

    rows, targets = np.concatenate([row_of(k, w) for k, w in seen]), system.offsets
    found, wanted = [], []
    for spread in (0.003, 0.05):
        precision = np.concatenate([np.full(system.count, spread**-2.0), system.fixed_precision])
        found.append(system.evidence(precision))
        covariance = np.diag(1.0 / system.row_weights) + (rows / precision) @ rows.T
        wanted.append(multivariate_normal(cov=covariance).logpdf(targets))
    assert found[1] - found[0] == pytest.approx(wanted[1] - wanted[0], rel=1e-6)
    assert abs(found[1] - found[0]) > 1.0
    other = OutlineSystem(seen, aligner._weights, aligner._patch, aligner.values, False)
    other.weigh_as(system)
    assert other.evidence(precision) == found[1]


def test_what_is_nearest_to_places_is_counted(whole_body: Body) -> None:
    """Of two halves of the body, what is counted adds up to the whole; a leg that is off is off in its own half."""
    look = looks(whole_body, motion, wrong(0.05))[4]
    nothing = np.zeros((24, 3)), np.zeros(3)
    legs = np.isin(whole_body.weights.argmax(dim=1).numpy(), [1, 2, 4, 5, 7, 8, 10, 11])
    turned = np.zeros((24, 3))
    turned[4, 0] = 0.5
    corrections = [nothing, (turned, np.zeros(3))]
    all_, own, other = (misfits(whole_body, look, corrections, of) for of in (legs | True, legs, ~legs))
    np.testing.assert_allclose(own + other, all_, rtol=1e-12)
    assert own[1] - own[0] > 3.0 * abs(other[1] - other[0])
    assert not misfits(whole_body, look, corrections, legs & False).any()


def test_values_are_those_of_the_nearest_pixel() -> None:
    rng = np.random.default_rng(2)
    where, values = rng.random((20, 31)) < 0.05, rng.integers(0, 999, (20, 31))
    found, places = _spread(values, where), np.argwhere(where)
    for pixel in np.ndindex(found.shape):
        distances = np.linalg.norm(places - pixel, axis=1)
        near = places[
            distances <= 1.03 * distances.min()
        ]  # the transform's distances are off by some percent
        assert found[pixel] in values[tuple(near.T)]
    assert not _spread(values, np.zeros_like(where)).any()


def align_poses(found: list[Look], body: Body, every: int) -> Alignment | None:
    return align_with(found, body, PoseSpline.over([look.index for look in found], every))


def aligned(body: Body, found: list[Look]) -> tuple[Alignment, list[Pose]]:
    frames = [look.index for look in found]
    alignment = align_sequence(lambda k: found[k], frames, body, 4, registered=False)
    assert alignment is not None
    spline = alignment.spline()
    return alignment, [aligned_pose(look.pose, spline, body) for look in found]


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [0.0, 2.0])
def test_errors_that_last_no_longer_than_a_frame_are_put_right(whole_body: Body, pixels: float) -> None:
    """Their knots lie at each frame, also where edges of masks are off; those of smooth errors farther apart."""
    found = looks(whole_body, wrong(0.05, 0.01, every=1), motion)
    found = wander(found, pixels) if pixels else found
    before = off(whole_body, [look.pose for look in found], motion)
    assert likely_spacing(found, whole_body, 4) == 1
    _, poses = aligned(whole_body, found)
    after = off(whole_body, poses, motion)
    assert after[0] < 0.75 * before[0] and after[1] < 1.1 * before[1]
    smooth = wrong(0.05, 0.01)
    assert likely_spacing(looks(whole_body, smooth, motion), whole_body, 4) > 1
    assert likely_spacing(found[:3], whole_body, 4) == 4  # too few to ask
    assert likely_spacing(found, whole_body, 1) == 1


@pytest.mark.slow
def test_wrong_poses_are_put_right(whole_body: Body) -> None:
    found = looks(whole_body, wrong(0.06, 0.02), motion)
    before = off(whole_body, [look.pose for look in found], motion)
    alignment, poses = aligned(whole_body, found)
    after = off(whole_body, poses, motion)
    assert before[0] > 25.0 and before[1] > 15.0
    assert after[0] < 0.4 * before[0]
    assert after[1] < 0.9 * before[1]
    assert alignment.noise < 0.3 < alignment.before
    assert not alignment.shows_shift
    limbs = [alignment.spreads[name] for name in ("hips", "knees", "shoulders", "elbows")]
    assert 0.02 < np.median(limbs) < 0.12  # 0.06 was given


@pytest.mark.slow
def test_right_poses_are_left_alone(whole_body: Body) -> None:
    alignment, poses = aligned(whole_body, looks(whole_body, motion, motion))
    assert max(off(whole_body, poses, motion)) < 1.5
    assert alignment.spline().place_reach.max() < 0.15  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.parametrize(("spread", "pixels"), [(0.0, 3.0), (0.01, 1.0), (0.03, 2.0)])
def test_masks_whose_edges_wander_are_told_from_poses(whole_body: Body, spread: float, pixels: float) -> None:
    """Places left out gain by poses that are mended, and hardly by edges that are explained."""
    given = wrong(spread, 0.3 * spread) if spread else motion
    found = align_poses(wander(looks(whole_body, given, motion), pixels), whole_body, 4)
    assert found is not None and found.is_taken == bool(spread)
    assert found.gain > 1.2 * WORTH if spread else found.gain < 0.3 * WORTH


def test_another_build_is_not_taken_for_poses(whole_body: Body) -> None:
    """The person is broader and taller than the body as given: joints hardly move for that."""
    betas = torch.tensor([0.3, 0.8, -0.6, 0.5, 0.0, 0.0, 0.4, 0.0, 0.0, 0.0])

    def true(k: int) -> Pose:
        return replace(motion(k), betas=betas)

    found = looks(whole_body, motion, true)
    alignment, poses = aligned(whole_body, found)
    assert alignment.before > 0.5  # pixels: there is much to misunderstand
    assert max(off(whole_body, poses, motion)) < 6.0


@pytest.mark.slow
def test_a_strip_in_front_is_no_outline(whole_body: Body) -> None:
    found = looks(whole_body, motion, motion, hide=slice(50, 60))
    _, poses = aligned(whole_body, found)
    assert max(off(whole_body, poses, motion)) < 4.0
    found = looks(whole_body, wrong(0.06, 0.02), motion, hide=slice(50, 60))
    before = off(whole_body, [look.pose for look in found], motion)
    _, poses = aligned(whole_body, found)
    assert off(whole_body, poses, motion)[0] < 0.6 * before[0]


@pytest.mark.slow
def test_a_shift_of_all_pictures_is_told_from_poses(whole_body: Body) -> None:
    own = camera()
    K = own.K.clone()
    K[0, 2] -= 0.8
    found = [replace(look, camera=replace(own, K=K)) for look in looks(whole_body, motion, motion)]
    alignment = align_poses(found, whole_body, 4)
    assert alignment is not None and alignment.shows_shift
    np.testing.assert_allclose(alignment.picture[:2], [0.8, 0.0], atol=0.15)


def test_too_few_frames_tell_nothing(whole_body: Body) -> None:
    found = looks(whole_body, motion, motion)
    assert align_poses(found[:3], whole_body, 4) is None
    empty = [replace(look, seen=np.zeros_like(look.seen)) for look in found]
    assert align_poses(empty, whole_body, 4) is None


def test_groups_have_each_joint_once() -> None:
    assert sorted(joint for joints in GROUPS.values() for joint in joints) == list(range(24))


def test_what_the_video_does_not_tell_hardly_learns() -> None:
    spline = PoseSpline(0.0, 4.0, 6, aligned=True)
    base, reach = 0.1 * torch.randn(6, 24, 3), torch.rand(6, 24, 3)
    reach[:, 5] = 0.0
    spline.start_at(base, torch.ones(6, 3), reach, torch.zeros(6, 3))
    plain = PoseSpline(0.0, 4.0, 6)
    plain.turns.data, plain.places.data = base.clone(), torch.ones(6, 3)
    torch.testing.assert_close(spline.at(5)[0], plain.at(5)[0])
    before = [part.detach().clone() for part in spline.at(5)]
    adam = torch.optim.Adam(spline.parameters(), lr=1e-2)
    turns, places = spline.at(5)
    (turns.sum() + places.sum()).backward()
    adam.step()
    moved = [(a - b).abs().detach() for a, b in zip(spline.at(5), before, strict=True)]
    assert not moved[0][5].any() and not moved[1].any()
    assert moved[0][0].min() > 0.0
    with pytest.raises(ValueError, match="aligned"):
        plain.start_at(base, torch.ones(6, 3), reach, torch.zeros(6, 3))


def test_an_aligned_spline_survives_its_file(body: Body, tmp_path) -> None:  # type: ignore[no-untyped-def]
    spline = PoseSpline(0.0, 4.0, 6, aligned=True)
    spline.start_at(torch.randn(6, 24, 3), torch.randn(6, 3), torch.rand(6, 24, 3), torch.rand(6, 3))
    save_avatar(tmp_path / "a.safetensors", Avatar(body, pose_spline=spline))
    found = load_avatar(tmp_path / "a.safetensors", body).pose_spline
    assert found is not None and found.aligned
    for ours, theirs in zip(spline.at(7), found.at(7), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0)


def test_of_a_long_sequence_a_part_is_looked_at_and_all_is_put_right(
    whole_body: Body, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pilot tells what is alike, pieces the rest; it ends where one system of all equations does."""
    found = looks(whole_body, wrong(0.03), motion)
    before, _ = off(whole_body, [look.pose for look in found], motion)
    _, at_once = aligned(whole_body, found)
    for name, value in {"ONE_SYSTEM": 8, "PILOT": 12, "BLOCK": 6, "PIECE": 4}.items():
        monkeypatch.setattr(sequence_alignment, name, value)
    asked: list[int] = []

    def look_at(position: int) -> Look:
        asked.append(position)
        return found[position]

    monkeypatch.setattr(sequence_alignment, "likely_spacing", lambda *_, **__: 4)
    alignment = align_sequence(look_at, range(FRAMES), whole_body, 4, registered=False)
    assert alignment is not None and alignment.is_taken
    assert set(asked[FRAMES:]) <= set(positions_looked_at(FRAMES, 4)) and {0, FRAMES - 1} <= set(asked)
    assert alignment.first == 0
    assert alignment.spacing * (len(alignment.turns) - 3) == pytest.approx(FRAMES - 1)
    spline = alignment.spline()
    poses = [aligned_pose(look.pose, spline, whole_body) for look in found]
    across, _ = off(whole_body, poses, motion)
    assert across < 0.7 * before
    assert across < 1.6 * off(whole_body, at_once, motion)[0]
    exact = looks(whole_body, motion, motion)
    nothing = align_sequence(lambda k: exact[k], range(FRAMES), whole_body, 4, registered=False)
    assert nothing is not None and not nothing.is_taken and not nothing.turns.any()


def test_pieces_have_each_knot_once_and_all_frames_that_know_it() -> None:
    frames = list(range(0, 3000, 4))
    spline = PoseSpline.over(range(3000), 8)
    parts = list(pieces(spline, frames))
    assert [k for own, _ in parts for k in own] == list(range(spline.knots))
    for own, near in parts:
        knowing = {
            k for k, frame in enumerate(frames) if spline_weights(spline, frame)[own.start : own.stop].any()
        }
        assert knowing <= set(near) and near == sorted(near)
        assert len(near) < 2.2 * sequence_alignment.PIECE + 20
    chosen = pilot_positions(len(frames))
    assert chosen == sorted(set(chosen)) and len(chosen) == sequence_alignment.PILOT
    assert chosen[0] == 0 and chosen[-1] == len(frames) - 1


def test_a_part_of_an_outline_has_all_of_each_of_its_points(whole_body: Body) -> None:
    look = looks(whole_body, wrong(0.03), motion)[5]
    witness = observe_outline(whole_body, look, (np.zeros((24, 3)), np.zeros(3)), 0.08)
    assert witness is not None
    half = witness.only(slice(None, None, 2))
    assert (half.size, half.focal) == (witness.size, witness.focal)
    for name in ("offsets", "turns", "shape", "picture", "per_metre", "vertices"):
        np.testing.assert_array_equal(getattr(half, name), getattr(witness, name)[::2], err_msg=name)


@pytest.mark.parametrize(
    ("count", "found", "every", "looks"),
    [
        (10, 4, 4, 10),
        (100, 4, 4, 100),
        (480, 4, 4, 240),
        (500, 4, 5, 240),
        (1000, 4, 8, 250),
        (2000, 4, 8, 500),
        (8000, 4, 16, 1000),
        (500, 2, 2, 500),  # where errors change as fast, knots do not lie farther apart
        (400, 1, 1, 400),
        (2000, 1, 4, 1000),
    ],
)
def test_knots_of_a_long_sequence_stay_near_each_other(
    count: int, found: int, every: int, looks: int
) -> None:
    assert frames_a_knot(count, found, 4) == every
    positions = positions_looked_at(count, every)
    assert len(positions) == len(set(positions)) == looks
    assert positions[0] == 0 and positions[-1] == count - 1
    assert frames_a_knot(count, 20, 20) == 20
    # of a video whose every second frame is trained on, they lie as many frames of it apart
    least = -(-count // 500)
    assert frames_a_knot(count, 4, 4, stride=1.6) == max(4, min(5, -(-count // 120)), least)
    assert frames_a_knot(count, 4, 4, stride=5.0) == max(4, least)
    assert frames_a_knot(1200, 4, 4, stride=5 / 3) == 4  # 6.7 frames of the video: five were 8.3, and worse
    asked = window(count)
    assert len(asked) == min(count, 50) and count - asked.stop - asked.start in (0, 1)


def test_shapes_that_change_from_frame_to_frame_are_each_frames_own(whole_body: Body) -> None:
    """Some fits have another shape at each moment; what is kept of the last one is not taken for this one's."""
    found = looks(whole_body, wrong(0.03), motion)
    shapes = torch.linspace(-1.0, 1.0, len(found))[:, None] * torch.ones(10)
    varied = [
        replace(look, pose=replace(look.pose, betas=own)) for look, own in zip(found, shapes, strict=True)
    ]
    spline, before = PoseSpline.over([look.index for look in found], 4), torch.get_num_threads()
    alone = [Aligner([look], whole_body, spline).observe([0], 0.08) for look in varied]
    try:
        torch.set_num_threads(3)
        together = Aligner(varied, whole_body, spline).observe(range(len(varied)), 0.08)
    finally:
        torch.set_num_threads(before)
    for (_, one), [(_, other)] in zip(together, alone, strict=True):
        np.testing.assert_array_equal(one.offsets, other.offsets)
        np.testing.assert_array_equal(one.turns, other.turns)


def test_alignment_is_the_same_for_any_number_of_threads(whole_body: Body) -> None:
    given = wrong(0.06)
    found, before = looks(whole_body, given, motion), torch.get_num_threads()
    results = []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            results.append(align_poses(found, whole_body, 6))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    one, three = results
    assert one is not None and three is not None and one.is_taken
    for name, value in vars(one).items():
        np.testing.assert_array_equal(value, getattr(three, name), err_msg=name)
