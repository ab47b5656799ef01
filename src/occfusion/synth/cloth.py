"""What cloth does in hard scenes: wrinkles where joints bend, and skirts and hair that swing behind.

Neither is a function that linear blend skinning can represent: wrinkles depend on the pose, and swinging
on its history.
"""

from __future__ import annotations

import numpy as np

from occfusion.synth.dress import Figure
from occfusion.synth.fullbody import bone_transforms, load_full_body, skin
from occfusion.synth.motion import Take
from occfusion.synth.noise import value_noise
from occfusion.synth.regions import step
from occfusion.synth.rotations import Floats

WRINKLE_REACH = 0.11  # metres from a joint
WRINKLE_WIDTH = 0.030  # metres from crest to crest
WRINKLE_DEPTH = 0.006  # metres at full bend
WRINKLE_SHADE = 0.22  # relative darkening in the valleys at full bend
FULL_BEND = 1.4  # radians
BENDING = (1, 2, 3, 4, 5, 6, 9, 16, 17, 18, 19)  # hips, spine, knees, shoulders, elbows
LOOSE_SWING = 0.12  # share by which cloth on the body swings, per centimetre that it stands off
LAG = 0.45  # share of the last offset that is left after a frame; a skirt settles in about three
MAX_SWING = 0.07  # metres


def wrinkles(figure: Figure, take: Take, frame: int, seed: int) -> tuple[Floats, Floats]:
    """Returns how far wrinkles lift each vertex in metres, and the factor on its brightness, both `[V]`.

    Creases run across the limb beside each bent joint; where exactly wanders with the pose.
    """
    pose = take.poses[frame].reshape(24, 3)
    points = figure.template
    wave, strength = np.zeros(len(points)), np.zeros(len(points))
    worn = step(figure.cloth, 0.004, 0.004)
    for joint in BENDING:
        bend = min(float(np.linalg.norm(pose[joint])) / FULL_BEND, 1.0)
        if bend < 0.05:
            continue
        place = load_full_body().J_template[joint]
        away = points - place
        reach = np.exp(-0.5 * (np.linalg.norm(away, axis=1) / (0.5 * WRINKLE_REACH)) ** 2)
        near = reach > 0.01
        along = away[near] @ _limb_direction(joint)
        # the phase follows the axis of the bend, so creases travel as the joint moves
        phase = 3.0 * float(pose[joint].sum()) + 2.5 * value_noise(points[near], 0.05, seed + joint)
        crease = np.sin(2.0 * np.pi * along / WRINKLE_WIDTH + phase)
        wave[near] += bend * reach[near] * crease
        strength[near] = np.maximum(strength[near], bend * reach[near])
    lift = WRINKLE_DEPTH * worn * (wave + 0.5 * strength)
    return lift, 1.0 + WRINKLE_SHADE * worn * np.clip(wave, -1.0, 0.6)


def _limb_direction(joint: int) -> Floats:
    """Returns along which axis of the template the limb at a joint runs, `[3]`."""
    return np.array([1.0, 0.0, 0.0]) if joint >= 16 else np.array([0.0, 1.0, 0.0])


def swing(figure: Figure, take: Take) -> tuple[np.ndarray, Floats]:
    """Returns the vertices that swing, `[S]`, and their offset in each frame, `[T, S, 3]`, metres, y up.

    Each follows its skinned place with a lag (a first-order filter over the frames) and less so the
    more firmly it is attached.
    """
    share = np.maximum(figure.hanging, np.clip(LOOSE_SWING * 100.0 * (figure.cloth - 0.004), 0.0, 0.3))
    moving = np.flatnonzero(share > 0.01)
    parents = load_full_body().parents
    offsets = np.zeros((len(take.poses), len(moving), 3))
    last = np.zeros((len(moving), 3))
    before = np.zeros((len(moving), 3))
    for frame, (pose, transl) in enumerate(zip(take.poses, take.transl, strict=True)):
        transforms = bone_transforms(pose, figure.joints, parents)
        place = skin(figure.rest[moving], figure.weights[moving], transforms) + transl
        if frame:
            last = LAG * (last + before - place)
        before = place
        offset = share[moving, None] * last
        length = np.linalg.norm(offset, axis=1, keepdims=True)
        offsets[frame] = offset * np.minimum(1.0, MAX_SWING / np.maximum(length, 1e-9))
    return moving, offsets
