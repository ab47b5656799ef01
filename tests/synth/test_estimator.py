"""The level `wild`: how far parameters and calibration are off, in which directions, and how smoothly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from occfusion.synth import estimator
from occfusion.synth.fullbody import bone_transforms, load_model_body, skin
from occfusion.synth.motion import Take
from occfusion.synth.rotations import Floats, axis_angle_from_quaternion, multiply, quaternion_from_axis_angle
from occfusion.synth.scene import Scene
from occfusion.synth.spec import SceneSpec
from occfusion.synth.studio import Y_UP_TO_Z_UP, make_cameras

FRAMES = 400
CAMERA = make_cameras(1, 128)[0]
INTO_CAMERA = CAMERA.R @ Y_UP_TO_Z_UP


def whole_turns(poses: Floats) -> Floats:
    """Rotations of all joints in the body's frame, quaternions `[T, 24, 4]`, by a loop that shares no code."""
    local = quaternion_from_axis_angle(poses.reshape(-1, 24, 3))
    out = local.copy()
    for joint, parent in enumerate(load_model_body().parents):
        if parent >= 0:
            out[:, joint] = multiply(out[:, parent], local[:, joint])
    return out


def errors_in_camera(true: Take, given: Take, joint: int) -> Floats:
    """What a joint's own turn is off, in the camera's axes, `[T, 3]`, radians."""
    body = load_model_body()
    parent = body.parents[joint]
    above = whole_turns(true.poses)[:, parent]
    turns = [quaternion_from_axis_angle(t.poses.reshape(-1, 24, 3))[:, joint] for t in (true, given)]
    back = [1.0, -1.0, -1.0, -1.0]
    off = multiply(turns[1], turns[0] * back)  # in the parent's axes
    return axis_angle_from_quaternion(multiply(multiply(above, off), above * back)) @ INTO_CAMERA.T


@pytest.fixture(scope="module")
def moving() -> Take:
    rng = np.random.default_rng(3)
    return Take(0.4 * rng.standard_normal((FRAMES, 72)), np.zeros((FRAMES, 3)))


def test_turns_are_off_more_along_the_line_of_sight(moving: Take) -> None:
    hidden = np.zeros((FRAMES, 24))
    given = estimator.estimate_take(moving, hidden, CAMERA, np.random.default_rng(0))
    off = np.stack([errors_in_camera(moving, given, joint) for joint in range(1, 24)])
    spread = off.std(axis=(0, 1))
    np.testing.assert_allclose(spread, [estimator.ALONG, estimator.ALONG, estimator.ACROSS], rtol=0.1)


def test_hidden_joints_are_off_twice_as_much(moving: Take) -> None:
    hidden = np.zeros((FRAMES, 24))
    hidden[:, 18:] = 1.0
    given = estimator.estimate_take(moving, hidden, CAMERA, np.random.default_rng(0))
    seen, not_seen = (
        np.concatenate([errors_in_camera(moving, given, j) for j in joints]).std()
        for joints in ((1, 2, 4, 5), (18, 19, 20, 21))
    )
    assert not_seen / seen == pytest.approx(1.0 + estimator.HIDDEN, rel=0.15)


def test_errors_are_smooth_and_places_drift() -> None:
    still = Take(np.zeros((FRAMES, 72)), np.zeros((FRAMES, 3)))
    given = estimator.estimate_take(still, np.zeros((FRAMES, 24)), CAMERA, np.random.default_rng(1))
    assert np.abs(np.diff(given.poses, axis=0)).mean() < 0.4 * np.abs(given.poses).mean()
    place = given.transl @ INTO_CAMERA.T
    wanted = np.hypot(
        [estimator.PLACE_ACROSS, estimator.PLACE_ACROSS, estimator.PLACE_ALONG],
        [estimator.DRIFT_ACROSS, estimator.DRIFT_ACROSS, estimator.DRIFT_ALONG],
    )
    np.testing.assert_allclose(np.sqrt((place**2).mean(axis=0)), wanted, rtol=0.35)  # ten drifts in all
    slow = np.stack([np.convolve(p, np.ones(25) / 25, mode="valid") for p in place.T])
    assert slow.std(axis=1)[2] > 0.5 * estimator.DRIFT_ALONG  # it does not average out


def test_a_joint_behind_the_body_or_a_thing_is_hidden() -> None:
    scene = Scene(replace(SceneSpec.parse("002-wild-boxes"), image_size=32, frames=12, cameras=1))
    free = estimator.hidden_joints(scene.take, scene.subject.betas, None, 0.0)
    behind = estimator.hidden_joints(scene.take, scene.subject.betas, scene._occluder, scene._width)
    assert free.shape == (12, 24) and free.min() >= 0.0 and behind.max() <= 1.0
    assert 0.0 < free.mean() < 0.4
    assert behind.mean() > free.mean() + 0.1
    assert (behind >= free - 1e-9).all()


def test_a_wild_scene_is_off_in_all_that_it_says() -> None:
    scene = Scene(replace(SceneSpec.parse("003-wild"), image_size=64, frames=40, cameras=3))
    exact = Scene(replace(SceneSpec.parse("003-camera"), image_size=64, frames=40, cameras=3))
    np.testing.assert_array_equal(scene.take.poses, exact.take.poses)
    for ours, theirs in zip(scene.shots(3), exact.shots(3), strict=True):  # the same footage
        np.testing.assert_array_equal(ours.image, theirs.image)
        np.testing.assert_array_equal(ours.mask, theirs.mask)
    assert 0.05 < np.abs(scene.disk_betas - scene.subject.betas).mean() < 0.8
    assert all((scene.parameters(k).shapes == scene.disk_betas).all() for k in (0, 20))  # one shape
    ratio = {
        round(float(d.K[0, 0] / t.K[0, 0]), 6) for d, t in zip(scene.disk_cameras, scene.cameras, strict=True)
    }
    assert len(ratio) == 1 and abs(abs(ratio.pop() - 1.0) - estimator.FOCAL) < 1e-5
    shifts = [d.K[:2, 2] - t.K[:2, 2] for d, t in zip(scene.disk_cameras, scene.cameras, strict=True)]
    np.testing.assert_allclose(np.linalg.norm(shifts, axis=1), estimator.SHIFT)
    np.testing.assert_allclose(shifts, np.tile(shifts[0], (3, 1)))
    body = load_model_body()
    joints = body.regressor @ body.template
    off = []
    for frame in range(40):
        true, disk = (
            skin(joints, np.eye(24), bone_transforms(t.poses[frame], joints, body.parents)) + t.transl[frame]
            for t in (scene.take, scene.disk_take)
        )
        off.append((disk - true) @ INTO_CAMERA.T)
    across, along = np.square(off)[..., :2].mean() ** 0.5, np.square(off)[..., 2].mean() ** 0.5
    assert 0.01 < across < 0.05 and along > 1.3 * across
