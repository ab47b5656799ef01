"""Movements set by hand as key poses: wave, squat, reach, sit, walk, lunge; and standing still.

Axis-angles in radians on SMPL's joints. Hips bend by -x, knees by +x; the left elbow by -y and the right
by +y; arms come down from the T-pose by -z on the left and +z on the right.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from occfusion.synth.rotations import Floats

L_HIP, R_HIP, SPINE1, L_KNEE, R_KNEE, SPINE2, L_ANKLE, R_ANKLE = range(1, 9)
NECK, HEAD, L_SHOULDER, R_SHOULDER, L_ELBOW, R_ELBOW = 12, 15, 16, 17, 18, 19

ARMS_DOWN = 1.1  # radians from the T-pose; more pushes the arms into loose clothes

Key = dict[int, tuple[float, float, float]]
Move = Callable[[Floats, np.random.Generator], Floats]


def stand() -> Floats:
    """Returns a relaxed stand, `[24, 3]`."""
    return _pose({})


def _pose(key: Key) -> Floats:
    base: Key = {
        L_SHOULDER: (0.0, 0.0, -ARMS_DOWN),
        R_SHOULDER: (0.0, 0.0, ARMS_DOWN),
        L_ELBOW: (0.0, -0.25, 0.0),
        R_ELBOW: (0.0, 0.25, 0.0),
        L_HIP: (0.0, 0.0, 0.06),
        R_HIP: (0.0, 0.0, -0.06),
    }
    out = np.zeros((24, 3))
    for joint, value in (base | key).items():
        out[joint] = value
    return out


def _between(phase: Floats, *keys: Floats) -> Floats:
    """Returns key poses joined smoothly, `[T, 24, 3]`; `phase` runs from 0 to 1 over all of them."""
    place = np.clip(phase, 0.0, 1.0) * (len(keys) - 1)
    left = np.minimum(place.astype(int), len(keys) - 2)
    share = place - left
    share = (share * share * (3.0 - 2.0 * share))[:, None, None]
    poses = np.stack(keys)
    return (1.0 - share) * poses[left] + share * poses[left + 1]


def wave(phase: Floats, rng: np.random.Generator) -> Floats:
    """Returns an arm held up that waves; the side is drawn."""
    right = bool(rng.integers(2))
    sign = 1.0 if right else -1.0
    shoulder, elbow = (R_SHOULDER, R_ELBOW) if right else (L_SHOULDER, L_ELBOW)
    up = {shoulder: (0.0, 0.2 * sign, -0.55 * sign)}
    side_a = _pose(up | {elbow: (0.0, 0.3 * sign, -0.9 * sign), HEAD: (0.0, 0.2 * sign, 0.0)})
    side_b = _pose(up | {elbow: (0.0, 0.3 * sign, -0.3 * sign), SPINE2: (0.0, 0.0, 0.08 * sign)})
    return _between(phase, stand(), side_a, side_b, side_a, side_b, stand())


def squat(phase: Floats, rng: np.random.Generator) -> Floats:
    """Returns knees bent with the arms stretched forward; the depth is drawn."""
    deep = rng.uniform(0.8, 1.15)
    down = _pose(
        {
            L_HIP: (-1.35 * deep, 0.0, 0.2),
            R_HIP: (-1.35 * deep, 0.0, -0.2),
            L_KNEE: (1.8 * deep, 0.0, 0.0),
            R_KNEE: (1.8 * deep, 0.0, 0.0),
            L_ANKLE: (-0.5 * deep, 0.0, 0.0),
            R_ANKLE: (-0.5 * deep, 0.0, 0.0),
            SPINE1: (0.35 * deep, 0.0, 0.0),
            L_SHOULDER: (0.0, -1.3, -0.15),
            R_SHOULDER: (0.0, 1.3, 0.15),
        }
    )
    return _between(phase, stand(), down, down, stand())


def walk(phase: Floats, rng: np.random.Generator) -> Floats:
    """Returns steps on the spot with swinging arms; the stride is drawn."""
    stride = rng.uniform(0.35, 0.6)
    out = np.repeat(stand()[None], len(phase), axis=0)
    ease = np.minimum(1.0, np.minimum(phase, 1.0 - phase) * 6.0)
    beat = 2.0 * np.pi * 2.0 * phase
    swing = stride * ease * np.sin(beat)
    lift = ease * np.cos(beat)
    out[:, L_HIP, 0] -= swing
    out[:, R_HIP, 0] += swing
    out[:, L_KNEE, 0] += 0.25 * ease + 0.9 * stride * np.maximum(0.0, lift)
    out[:, R_KNEE, 0] += 0.25 * ease + 0.9 * stride * np.maximum(0.0, -lift)
    out[:, L_SHOULDER, 1] += 0.8 * swing
    out[:, R_SHOULDER, 1] += 0.8 * swing
    out[:, SPINE2, 1] += 0.2 * swing
    return out


def reach(phase: Floats, rng: np.random.Generator) -> Floats:
    """Returns a reach up to one side and then down to the other; the side is drawn."""
    sign = 1.0 if rng.integers(2) else -1.0
    high = _pose(
        {
            L_SHOULDER: (0.0, -0.3, 0.9),
            R_SHOULDER: (0.0, 0.3, -0.9),
            L_ELBOW: (0.0, -0.1, 0.0),
            R_ELBOW: (0.0, 0.1, 0.0),
            SPINE1: (-0.1, 0.0, 0.15 * sign),
            NECK: (-0.25, 0.0, 0.0),
        }
    )
    low = _pose(
        {
            SPINE1: (0.45, 0.25 * sign, 0.0),
            SPINE2: (0.35, 0.2 * sign, 0.0),
            L_HIP: (-0.6, 0.0, 0.1),
            R_HIP: (-0.6, 0.0, -0.1),
            L_KNEE: (0.45, 0.0, 0.0),
            R_KNEE: (0.45, 0.0, 0.0),
            L_SHOULDER: (0.0, -1.0, -0.7),
            R_SHOULDER: (0.0, 1.0, 0.7),
        }
    )
    return _between(phase, stand(), high, high, low, stand())


def sit(phase: Floats, rng: np.random.Generator) -> Floats:
    """Returns sitting down on an imagined stool and standing up again."""
    angle = rng.uniform(1.25, 1.45)
    seated = _pose(
        {
            L_HIP: (-angle, 0.0, 0.15),
            R_HIP: (-angle, 0.0, -0.15),
            L_KNEE: (angle, 0.0, 0.0),
            R_KNEE: (angle, 0.0, 0.0),
            L_SHOULDER: (0.0, -0.75, -0.85),
            R_SHOULDER: (0.0, 0.75, 0.85),
            L_ELBOW: (0.0, -0.5, 0.0),
            R_ELBOW: (0.0, 0.5, 0.0),
            HEAD: (0.1, 0.3, 0.0),
        }
    )
    return _between(phase, stand(), seated, seated, stand())


def lunge(phase: Floats, rng: np.random.Generator) -> Floats:
    """Returns a deep step forward with the arms spread; the leading leg is drawn."""
    front, back = (L_HIP, R_HIP) if rng.integers(2) else (R_HIP, L_HIP)
    deep = _pose(
        {
            front: (-1.0, 0.0, 0.0),
            front + 3: (1.15, 0.0, 0.0),
            front + 6: (-0.15, 0.0, 0.0),
            back: (0.45, 0.0, 0.0),
            back + 3: (0.5, 0.0, 0.0),
            L_SHOULDER: (0.0, 0.0, -0.2),
            R_SHOULDER: (0.0, 0.0, 0.2),
        }
    )
    return _between(phase, stand(), deep, stand())


TRAINING_MOVES: tuple[Move, ...] = (wave, squat, walk)
HELD_OUT_MOVES: tuple[Move, ...] = (reach, sit, lunge)
