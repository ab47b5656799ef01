"""A take: recorded stretches and set movements, chained, turned slowly, and put on the floor.

The recordings are from the CMU Graphics Lab Motion Capture Database (see assets/NOTICE.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from occfusion.synth.fullbody import asset_arrays, bone_transforms, load_model_body, skin
from occfusion.synth.moves import HELD_OUT_MOVES, L_HIP, L_KNEE, R_HIP, R_KNEE, TRAINING_MOVES, Move
from occfusion.synth.rotations import (
    Floats,
    about_y,
    axis_angle_from_quaternion,
    multiply,
    quaternion_from_axis_angle,
    slerp,
)

CLIP_RATE = 30.0  # frames a second in the recordings
TAKE_RATE = 10.0  # frames a second in a take
MOVE_SECONDS = 3.2
FADE_SECONDS = 0.6
TURN_FRAMES = 100  # frames for one full turn, so that one camera sees every side
MAX_TURN = 0.26  # radians a frame (15 degrees): short takes turn faster, but not absurdly
FOOT_JOINTS = (7, 8, 10, 11)
LEG_JOINTS = (L_HIP, R_HIP, L_KNEE, R_KNEE, *FOOT_JOINTS)
SWAY = 0.12  # metres a person drifts from the middle of the studio
SEATED_SWAY = 0.02  # metres, on a seat
SEATED_BEND = 1.35  # radians of hips and knees

Stretch = tuple[str, int, int]

TRAINING_STRETCHES: tuple[Stretch, ...] = (
    ("cmu_01_01", 40, 170),
    ("cmu_01_01", 340, 470),
    ("cmu_01_03", 385, 500),
    ("cmu_01_03", 865, 990),
)
HELD_OUT_STRETCHES: tuple[Stretch, ...] = (
    ("cmu_01_01", 190, 330),
    ("cmu_01_01", 500, 640),
    ("cmu_01_03", 510, 610),
    ("cmu_01_03", 1000, 1120),
)


@dataclass(frozen=True)
class Take:
    """Motion of one person, y up.

    Attributes:
        poses: axis-angles, `[T, 72]`; the first three turn the body about the pelvis.
        transl: translation after that, `[T, 3]`, metres; the lowest point is on the floor, y = 0.
    """

    poses: Floats
    transl: Floats


@cache
def _recordings() -> dict[str, Floats]:
    data = asset_arrays("motions_cmu.npz")
    return {k[: -len("_pose")]: v.astype(np.float64) for k, v in data.items() if k.endswith("_pose")}


def _recorded(stretch: Stretch) -> Floats:
    """Returns a stretch as quaternions at the take's rate, `[T, 24, 4]`, always facing forward.

    The heading is taken from the body's left axis, which stays level when the person bends over.
    """
    name, first, last = stretch
    step = int(CLIP_RATE / TAKE_RATE)
    poses = _recordings()[name][first:last:step].reshape(-1, 24, 3)
    out = quaternion_from_axis_angle(poses)
    w, x, y, z = np.moveaxis(out[:, 0], -1, 0)
    heading = np.arctan2(-2.0 * (x * z - w * y), 1.0 - 2.0 * (y * y + z * z))
    out[:, 0] = multiply(about_y(-heading), out[:, 0])
    return out


def _moved(move: Move, rng: np.random.Generator) -> Floats:
    count = round(MOVE_SECONDS * TAKE_RATE)
    return quaternion_from_axis_angle(move(np.linspace(0.0, 1.0, count), rng))


def _chain(parts: list[Floats]) -> Floats:
    fade = round(FADE_SECONDS * TAKE_RATE)
    share: Floats = np.linspace(0.0, 1.0, fade + 2)[1:-1].astype(np.float64)
    out = parts[0]
    for part in parts[1:]:
        mixed = slerp(out[-fade:], part[:fade], share[:, None])
        out = np.concatenate([out[:-fade], mixed, part[fade:]])
    return out


def smooth_noise(rng: np.random.Generator, frames: int, channels: int, period: float) -> Floats:
    """Returns noise of variance one that wanders with about `period` frames, `[frames, channels]`."""
    knots = int(np.ceil(frames / period)) + 4
    values = rng.standard_normal((knots, channels))
    place = np.arange(frames) / period + 1.0
    left = place.astype(int)
    t = (place - left)[:, None]
    # cubic B-spline through random control values: smooth in velocity, as bodies and estimators are
    weights = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    out = sum(w * values[left + k - 1] for k, w in enumerate(weights)) / 6.0
    spread = np.sqrt(sum(w * w for w in weights)) / 6.0
    return np.asarray(out / spread)


def make_take(
    frames: int,
    betas: Floats,
    held_out: bool,
    rng: np.random.Generator,
    *,
    turn: float = 360.0,
    facing: float = 0.0,
    seated: bool = False,
) -> Take:
    """Returns a take of a person of that shape.

    Args:
        frames: how many.
        betas: shape, `[10]`; the floor depends on it.
        held_out: draw from the stretches and movements kept for evaluation.
        rng: source of all choices.
        turn: degrees that the body turns; 360: steadily all round, less: to and fro within so much.
        facing: middle of a turn to and fro, degrees; at 0 the body faces +z, at 90 +x.
        seated: legs stay seated; the rest moves as recorded.
    """
    stretches = HELD_OUT_STRETCHES if held_out else TRAINING_STRETCHES
    moves = HELD_OUT_MOVES if held_out else TRAINING_MOVES
    parts: list[Floats] = []
    length = 0
    while length < frames or len(parts) < 2:
        # each round plays all of them once in a new order, a movement and a recording in turn
        recorded, moved = rng.permutation(len(stretches)), rng.permutation(len(moves))
        for k in range(max(len(recorded), len(moved))):
            parts.append(_moved(moves[moved[k % len(moved)]], rng))
            parts.append(_recorded(stretches[recorded[k % len(recorded)]]))
        length = len(_chain(parts))
    quaternions = _chain(parts)[:frames]
    if seated:
        quaternions = _seated(quaternions, rng)
    if turn < 360.0:
        heading = np.radians(facing) + _to_and_fro(frames, np.radians(turn), rng)
    else:
        heading = _all_round(frames, rng)
    quaternions[:, 0] = multiply(about_y(heading), quaternions[:, 0])
    poses = axis_angle_from_quaternion(quaternions).reshape(frames, 72)
    transl = np.zeros((frames, 3))
    transl[:, [0, 2]] = (SEATED_SWAY if seated else SWAY) * smooth_noise(rng, frames, 2, 18.0)
    transl[:, 1] = -_lowest(poses, betas)
    return Take(poses, transl)


def _all_round(frames: int, rng: np.random.Generator) -> Floats:
    """Returns headings that go round and round, `[frames]`, radians."""
    step = min(2.0 * np.pi / min(frames, TURN_FRAMES), MAX_TURN)
    heading: Floats = rng.uniform(0.0, 2.0 * np.pi) + step * np.arange(frames, dtype=np.float64)
    return heading + 0.15 * smooth_noise(rng, frames, 1, 12.0)[:, 0]


def _to_and_fro(frames: int, sweep: float, rng: np.random.Generator) -> Floats:
    """Returns headings that swing about 0 within `sweep`, `[frames]`, radians; both ends are reached in a take."""
    # at its fastest a swing of that period turns by MAX_TURN a frame
    period = max(float(min(frames, TURN_FRAMES)), np.pi * sweep / MAX_TURN)
    phase = rng.uniform(0.0, 1.0) + np.arange(frames, dtype=np.float64) / period
    return np.asarray(0.5 * sweep * np.cos(2.0 * np.pi * phase))


def _seated(quaternions: Floats, rng: np.random.Generator) -> Floats:
    """Returns the poses with the legs of somebody who sits upright, `[T, 24, 4]`."""
    frames = len(quaternions)
    legs = np.zeros((frames, 24, 3))
    wander = smooth_noise(rng, frames, 4, 25.0)
    for side, (hip, knee) in enumerate(((L_HIP, L_KNEE), (R_HIP, R_KNEE))):
        bend = SEATED_BEND + 0.05 * wander[:, side]
        legs[:, hip, 0], legs[:, knee, 0] = -bend, bend
        legs[:, hip, 2] = (1.0 - 2.0 * side) * (0.15 + 0.04 * wander[:, 2 + side])
    out = quaternions.copy()
    out[:, LEG_JOINTS] = quaternion_from_axis_angle(legs)[:, LEG_JOINTS]
    out[:, 0] = (1.0, 0.0, 0.0, 0.0)  # whoever sits keeps the pelvis upright
    return out


def _lowest(poses: Floats, betas: Floats) -> Floats:
    """Returns the height of the lowest vertex of the feet in each pose, `[T]`, metres."""
    body = load_model_body()
    rest = body.template + body.shapedirs @ betas
    joints = body.regressor @ rest
    feet = body.weights[:, FOOT_JOINTS].sum(1) > 0.5
    points, weights = rest[feet], body.weights[feet]
    return np.array(
        [skin(points, weights, bone_transforms(p, joints, body.parents))[:, 1].min() for p in poses]
    )
