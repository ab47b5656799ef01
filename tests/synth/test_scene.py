from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from occfusion.geometry.zbuffer import rasterize_mesh
from occfusion.synth.disturb import disturb_mask, disturb_take, move_edge
from occfusion.synth.fullbody import bone_transforms, load_model_body, skin
from occfusion.synth.motion import Take
from occfusion.synth.rotations import matrix_from_axis_angle
from occfusion.synth.scene import Scene
from occfusion.synth.spec import SceneSpec
from occfusion.synth.studio import Y_UP_TO_Z_UP, make_cameras

SMALL = {"image_size": 128, "frames": 2, "cameras": 3}


def _scene(name: str, **settings: int | str) -> Scene:
    return Scene(replace(SceneSpec.parse(name), **(SMALL | settings)))  # type: ignore[arg-type]


def test_parameters_on_disk_give_the_vertices_on_disk() -> None:
    """x = R(Rh) SMPL(poses, shapes) + Th: the rotation is about the origin, not the pelvis."""
    scene, body = _scene("001-clean"), load_model_body()
    rest = body.template + body.shapedirs @ scene.subject.betas
    for frame in range(2):
        p = scene.parameters(frame)
        assert (p.poses[:3] == 0).all()
        local = skin(rest, body.weights, bone_transforms(p.poses, body.regressor @ rest, body.parents))
        world = local @ matrix_from_axis_angle(p.Rh).T + p.Th
        np.testing.assert_allclose(world, p.vertices, atol=1e-9)
        assert abs(p.vertices[:, 2].min()) < 1e-6  # z is up; the soles are on the floor


@pytest.mark.parametrize(("name", "least"), [("001-clean", 0.9), ("004-clean", 0.9), ("001-hard", 0.65)])
def test_vertices_project_into_the_masks(name: str, least: float) -> None:
    scene, faces = _scene(name), load_model_body().faces
    overlaps = []
    for frame in range(2):
        vertices = scene.parameters(frame).vertices
        for camera, shot in zip(scene.cameras, scene.shots(frame), strict=True):
            local = vertices @ camera.R.T + camera.T
            pixels = local @ camera.K.T
            body = rasterize_mesh(pixels[:, :2] / pixels[:, 2:], local[:, 2], faces, 128, 128).face >= 0
            overlaps.append((body & shot.mask).sum() / (body | shot.mask).sum())
    assert np.mean(overlaps) >= least


def test_clean_parameters_are_exact_and_hard_ones_are_off() -> None:
    clean, hard = (_scene(name, frames=40) for name in ("101-clean", "101-hard"))
    np.testing.assert_array_equal(clean.take.poses, hard.take.poses)  # the same motion
    np.testing.assert_array_equal(clean.disk_take.poses, clean.take.poses)
    body = load_model_body()
    joints = body.regressor @ body.template
    error = []
    for frame in range(40):
        true, disk = (
            skin(joints, np.eye(24), bone_transforms(t.poses[frame], joints, body.parents)) + t.transl[frame]
            for t in (hard.take, hard.disk_take)
        )
        error.append(np.linalg.norm(true - disk, axis=1).mean())
    assert 0.008 < np.mean(error) < 0.04  # metres: what a good estimator is off


def test_errors_are_smooth_in_time() -> None:
    still = Take(np.zeros((60, 72)), np.zeros((60, 3)))
    off = disturb_take(still, np.random.default_rng(0))
    assert np.abs(np.diff(off.poses, axis=0)).mean() < 0.4 * np.abs(off.poses).mean()


@pytest.mark.parametrize(
    "name", ["101-clean-boxes", "002-hard-moving", "003-clean-furniture", "004-hard-poles"]
)
def test_the_visible_is_part_of_the_complete(name: str) -> None:
    scene = _scene(name, frames=6, image_size=96)
    hidden = []
    for frame in (0, 3, 5):
        for number, shot in enumerate(scene.shots(frame)):
            assert shot.mask_complete is not None and shot.image_complete is not None
            assert not (shot.mask & ~shot.mask_complete).any()
            clear = shot.mask & ~_edge(shot.mask) & ~_edge(shot.mask_complete)
            np.testing.assert_array_equal(shot.image[clear], shot.image_complete[clear])
            if number == 0:
                hidden.append(1.0 - shot.mask.sum() / shot.mask_complete.sum())
    assert 0.1 < np.mean(hidden) < 0.75


def _edge(mask: np.ndarray) -> np.ndarray:
    """Returns the pixels within five pixels of the mask's edge."""
    reach = 5.0 * np.ones(mask.shape, np.float32)
    return move_edge(mask, reach) & ~move_edge(mask, -reach)


def test_without_occluders_the_mask_is_the_whole_person() -> None:
    with_, without = _scene("005-clean-boxes"), _scene("005-clean")
    for a, b in zip(with_.shots(1), without.shots(1), strict=True):
        assert b.mask_complete is None
        np.testing.assert_array_equal(a.mask_complete, b.mask)
        np.testing.assert_array_equal(a.image_complete, b.image)


def test_the_person_is_lit_before_a_dark_studio() -> None:
    for shot in _scene("000-clean").shots(0):
        background = shot.image[~move_edge(shot.mask, np.full(shot.mask.shape, 2.0, np.float32))]
        assert background.max() < 50
        assert shot.image[shot.mask].mean() > 2 * background.mean()
        assert 0.02 < shot.mask.mean() < 0.3


def test_small_pictures_are_large_ones_shrunk() -> None:
    large = next(iter(_scene("002-clean", image_size=256).shots(0)))
    small = next(iter(_scene("002-clean").shots(0)))
    halved = large.image.reshape(128, 2, 128, 2, 3).mean((1, 3))
    assert np.abs(halved - small.image)[large.mask.reshape(128, 2, 128, 2).all((1, 3))].mean() < 6.0


def test_cameras_stand_around_and_look_inwards() -> None:
    cameras = make_cameras(23, 1024)
    assert [c.name for c in cameras][:2] == ["Camera_B1", "Camera_B2"]
    angles = np.sort([np.arctan2(c.centre[1], c.centre[0]) for c in cameras])
    assert np.diff(angles).max() < np.radians(24)
    for camera in cameras:
        np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(camera.R) == pytest.approx(1.0)
        middle = camera.K @ (camera.R @ [0, 0, 0.96] + camera.T)
        assert np.abs(middle[:2] / middle[2] - 512).max() < 20
        above, below = (camera.K @ (camera.R @ [0, 0, h] + camera.T) for h in (1.5, 0.5))
        assert above[1] / above[2] < below[1] / below[2]  # up in the world is up in the picture
    np.testing.assert_allclose(make_cameras(23, 256)[4].K[:2] * 4, cameras[4].K[:2])


def test_body_frame_is_turned_not_mirrored() -> None:
    assert np.linalg.det(Y_UP_TO_Z_UP) == pytest.approx(1.0)
    np.testing.assert_array_equal(Y_UP_TO_Z_UP @ [0, 1, 0], [0, 0, 1])


def test_ragged_masks_err_a_little() -> None:
    rows, columns = np.mgrid[:200, :200]
    coverage = (np.hypot(rows - 100, columns - 100) < 60).astype(np.float32)
    ragged, _ = disturb_mask(coverage, 512, np.random.default_rng(0))
    true = coverage > 0.5
    overlap = (ragged & true).sum() / (ragged | true).sum()
    assert 0.9 < overlap < 0.995
    assert not disturb_mask(np.zeros((9, 9), np.float32), 512, np.random.default_rng(0))[0].any()


@pytest.mark.parametrize(
    ("name", "poses", "rotation", "place", "width", "pixels", "light"),
    [
        ("001-hard-boxes", 4.41958, -0.472269, -0.307268, 0.3288, 151, 30.635),
        ("104-clean-furniture", 3.388769, -2.215567, -0.104846, 0.126, 174, 21.643),
        ("003-clean-poles", 9.41746, 2.008495, -0.140109, 0.2182, 220, 30.314),
        ("002-hard-moving", 4.99933, 0.673951, -0.006015, 0.5977, 381, 41.92),
        ("107-clean", 3.093841, 1.172661, -0.044535, 0.0, 282, 21.273),
    ],
)
def test_scenes_stay_what_they_were(name, poses, rotation, place, width, pixels, light) -> None:
    """Figures of scenes as they were written before people could stand still; files were the same, byte for byte."""
    scene = _scene(name, image_size=64, frames=12, cameras=2)
    p, shot = scene.parameters(7), next(scene.shots(7))
    assert np.abs(p.poses).sum() == pytest.approx(poses, abs=1e-5)
    assert p.Rh[1] == pytest.approx(rotation, abs=1e-5)
    assert p.Th[0] == pytest.approx(place, abs=1e-5)
    assert getattr(scene, "_width", 0.0) == pytest.approx(width, abs=1e-3)
    assert abs(int(shot.mask.sum()) - pixels) <= 1
    assert shot.image.mean() == pytest.approx(light, abs=0.02)


def test_a_counter_hides_the_same_part_in_nearly_all_frames() -> None:
    scene, body = _scene("005-clean-counter", frames=12, image_size=96), load_model_body()
    feet = body.weights[:, [7, 8, 10, 11]].sum(1) > 0.5
    camera, seen = scene.cameras[0], []
    for frame in range(12):
        local = scene.parameters(frame).vertices[feet] @ camera.R.T + camera.T
        pixels = (local @ camera.K.T)[:, :2] / local[:, 2:]
        column, row = pixels.astype(int).T
        mask = next(scene.shots(frame)).mask
        inside = (row >= 0) & (row < 96) & (column >= 0) & (column < 96)
        seen.append(mask[row[inside], column[inside]].mean())
        assert mask.any()
    assert np.max(seen) < 0.05


def test_who_sits_has_a_low_seat_and_feet_on_the_floor() -> None:
    sitting, standing = _scene("003-clean-front-sit", frames=40), _scene("003-clean-front", frames=40)
    for frame in (0, 20, 39):
        assert sitting.parameters(frame).vertices[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    hips = [[_hip_height(s, k) for k in range(40)] for s in (sitting, standing)]
    assert max(hips[0]) < 0.65 < max(hips[1])
    assert np.ptp(hips[0]) < 0.1


def _hip_height(scene: Scene, frame: int) -> float:
    body = load_model_body()
    joints = body.regressor @ (body.template + body.shapedirs @ scene.disk_betas)
    return float(joints[0] @ [0, 1, 0] + scene.disk_take.transl[frame][1])
