from __future__ import annotations

import numpy as np
import pytest

from occfusion.synth.fullbody import bone_transforms, load_model_body, skin
from occfusion.synth.motion import HELD_OUT_STRETCHES, TRAINING_STRETCHES, make_take, smooth_noise
from occfusion.synth.moves import HELD_OUT_MOVES, TRAINING_MOVES
from occfusion.synth.rotations import (
    axis_angle_from_quaternion,
    matrix_from_axis_angle,
    multiply,
    quaternion_from_axis_angle,
    slerp,
)


def _take(frames: int = 100, held_out: bool = False, seed: int = 0):
    return make_take(frames, np.zeros(10), held_out, np.random.default_rng(seed))


def _facing(take) -> np.ndarray:
    forward = matrix_from_axis_angle(take.poses[:, :3])[:, :, 2]
    return np.unwrap(np.arctan2(forward[:, 0], forward[:, 2]))


def test_every_side_is_seen_within_a_hundred_frames() -> None:
    for held_out in (False, True):
        sectors = (np.degrees(_facing(_take(held_out=held_out))) % 360 // 30).astype(int)
        assert set(sectors) == set(range(12))


def test_someone_stands_on_the_floor() -> None:
    take, body = _take(30), load_model_body()
    joints = body.regressor @ body.template
    for pose, transl in zip(take.poses, take.transl, strict=True):
        low = (skin(body.template, body.weights, bone_transforms(pose, joints, body.parents)) + transl)[
            :, 1
        ].min()
        assert abs(low) < 1e-6
    assert np.abs(take.transl[:, [0, 2]]).max() < 0.6  # near the middle of the studio


def test_joints_do_not_jump() -> None:
    take = _take(200)
    turn = matrix_from_axis_angle(take.poses.reshape(-1, 24, 3))
    step = np.einsum("tjab,tjcb->tjac", turn[1:], turn[:-1])
    angle = np.arccos(np.clip((np.trace(step, axis1=2, axis2=3) - 1) / 2, -1, 1))
    assert angle[:, 1:].max() < 1.5  # radians in a tenth of a second


def test_held_out_people_move_differently() -> None:
    for a in TRAINING_STRETCHES:
        for b in HELD_OUT_STRETCHES:
            assert a[0] != b[0] or a[2] <= b[1] or b[2] <= a[1]
    assert not set(TRAINING_MOVES) & set(HELD_OUT_MOVES)
    train, held = (_take(100, held_out=h).poses[:, 3:] for h in (False, True))
    across = np.abs(train[:, None] - held[None]).mean(axis=2).min(axis=0)  # held-out frames to the nearest
    within = np.abs(train[::2, None] - train[None, 1::2]).mean(axis=2).min(axis=0)
    assert np.median(across) > 2.0 * np.median(within)


def test_the_same_seed_moves_the_same() -> None:
    np.testing.assert_array_equal(_take(40, seed=5).poses, _take(40, seed=5).poses)
    assert np.abs(_take(40, seed=5).poses - _take(40, seed=6).poses).max() > 0.3


@pytest.mark.parametrize("frames", [1, 2, 450])
def test_any_number_of_frames(frames: int) -> None:
    take = _take(frames)
    assert take.poses.shape == (frames, 72) and take.transl.shape == (frames, 3)
    assert np.isfinite(take.poses).all()


def test_rotations_agree_with_the_exponential() -> None:
    rng = np.random.default_rng(2)
    for vector in (*rng.uniform(-1.8, 1.8, (5, 3)), np.zeros(3), 1e-12 * np.ones(3), [np.pi, 0, 0]):
        vector = np.asarray(vector, dtype=float)
        skew = np.array([[0, -vector[2], vector[1]], [vector[2], 0, -vector[0]], [-vector[1], vector[0], 0]])
        series, term = np.eye(3), np.eye(3)
        for k in range(1, 40):
            term = term @ skew / k
            series = series + term
        np.testing.assert_allclose(matrix_from_axis_angle(vector), series, atol=1e-12)
        np.testing.assert_allclose(
            axis_angle_from_quaternion(quaternion_from_axis_angle(vector)), vector, atol=1e-12
        )


def test_slerp_is_constant_speed_on_the_short_way() -> None:
    a = quaternion_from_axis_angle(np.array([0.0, 0.4, 0.0]))
    b = -quaternion_from_axis_angle(np.array([0.0, 1.4, 0.0]))  # the same rotation, the other sign
    for t in (0.0, 0.25, 1.0):
        np.testing.assert_allclose(axis_angle_from_quaternion(slerp(a, b, t)), [0, 0.4 + t, 0], atol=1e-12)
    np.testing.assert_allclose(slerp(a, a, 0.3), a, atol=1e-12)
    inverse = a * [1, -1, -1, -1]
    np.testing.assert_allclose(multiply(a, inverse), [1, 0, 0, 0], atol=1e-12)


def test_smooth_noise_has_variance_one_and_wanders() -> None:
    noise = smooth_noise(np.random.default_rng(0), 4000, 3, 8.0)
    assert noise.shape == (4000, 3)
    assert noise.std() == pytest.approx(1.0, rel=0.1)
    assert np.abs(np.diff(noise, axis=0)).std() < 0.35
