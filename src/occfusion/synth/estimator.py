"""Body parameters and calibration as an estimator gives them from the first camera's video: the level `wild`.

Errors are smooth in time. Along the line of sight they are larger, for one camera hardly tells; and so they are of
joints that it does not see, behind the body itself or behind an occluder. A strip that is laid over pictures later is
not known here. The shape is wrong by one and the same error in all frames, places drift slowly, and all cameras' files
have one focal length that is off and pictures shifted by half a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from occfusion.geometry.zbuffer import rasterize_mesh
from occfusion.synth.fullbody import bone_transforms, load_model_body, skin
from occfusion.synth.motion import Take, smooth_noise
from occfusion.synth.occluders import Occluder
from occfusion.synth.rotations import Floats, axis_angle_from_quaternion, multiply, quaternion_from_axis_angle
from occfusion.synth.studio import Y_UP_TO_Z_UP, StudioCamera, make_cameras

ACROSS, ALONG = 0.022, 0.040
"""Radians: standard deviation of a joint's turn about the line of sight, which moves the picture, and of each of the
two others, which mostly move along it."""
HIDDEN = 1.0  # how much more of it where the first camera does not see the joint
ROOT = 0.5  # of a joint's: the trunk is the best seen
PERIOD, DRIFT_PERIOD = 8.0, 40.0  # frames over which errors wander, and drift
PLACE_ACROSS, PLACE_ALONG = 0.005, 0.012  # metres
DRIFT_ACROSS, DRIFT_ALONG = 0.007, 0.020
SHAPE = 0.4  # standard deviations; of the first component, which is size, a quarter (2 cm)
FOCAL = 0.006  # of the focal length, longer or shorter
SHIFT = 0.5  # pixels of the written pictures, in one direction
INSIDE = 0.15  # metres behind the surface from which on a joint is hidden: it lies inside the body itself
SEEN_SIZE = 128  # pixels at which it is found out
SMOOTH = 2.0  # frames: an estimator looks at neighbours


def estimate_shape(betas: Floats, rng: np.random.Generator) -> Floats:
    """Returns the shape as an estimator would give it, `[10]`."""
    error = SHAPE * rng.standard_normal(len(betas))
    error[0] /= 4.0
    return betas + error


def estimate_cameras(cameras: Sequence[StudioCamera], rng: np.random.Generator) -> list[StudioCamera]:
    """Returns the cameras as they were calibrated."""
    focal, angle = 1.0 + FOCAL * rng.choice([-1.0, 1.0]), rng.uniform(0.0, 2.0 * np.pi)
    found = []
    for camera in cameras:
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= focal
        K[:2, 2] += SHIFT * np.array([np.cos(angle), np.sin(angle)])
        found.append(replace(camera, K=K))
    return found


def estimate_take(take: Take, hidden: Floats, camera: StudioCamera, rng: np.random.Generator) -> Take:
    """Returns the motion as an estimator would give it.

    Args:
        take: as it was, y up.
        hidden: of each joint in each frame, `[T, 24]`, 0 seen to 1.
        camera: that filmed it.
        rng: source of the errors.
    """
    body = load_model_body()
    frames = len(take.poses)
    to_body = (camera.R @ Y_UP_TO_Z_UP).T  # from the camera's axes to the body's
    spread = np.array([ALONG, ALONG, ACROSS])  # turns about x and y move things along z
    noise = smooth_noise(rng, frames, 72, PERIOD).reshape(frames, 24, 3)
    turns = noise * spread * (1.0 + HIDDEN * hidden[..., None])
    turns[:, 0] *= ROOT
    errors = quaternion_from_axis_angle(turns @ to_body.T)
    local = quaternion_from_axis_angle(take.poses.reshape(frames, 24, 3))
    # a joint's turn is meant in the camera's axes: it is carried into those of the parent, as it truly stands
    whole = np.empty_like(local)
    out = np.empty_like(local)
    for j, parent in enumerate(body.parents):
        above = np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)) if parent < 0 else whole[:, parent]
        whole[:, j] = multiply(above, local[:, j])
        back = above * [1.0, -1.0, -1.0, -1.0]
        out[:, j] = multiply(multiply(back, errors[:, j]), whole[:, j])
    place = np.array([PLACE_ACROSS, PLACE_ACROSS, PLACE_ALONG]) * smooth_noise(rng, frames, 3, PERIOD)
    place += np.array([DRIFT_ACROSS, DRIFT_ACROSS, DRIFT_ALONG]) * smooth_noise(rng, frames, 3, DRIFT_PERIOD)
    return Take(axis_angle_from_quaternion(out).reshape(frames, 72), take.transl + place @ to_body.T)


def hidden_joints(take: Take, betas: Floats, occluder: Occluder | None, width: float) -> Floats:
    """Returns how far the first camera does not see each joint in each frame, `[T, 24]`, 0 to 1, smooth in time."""
    body, camera = load_model_body(), make_cameras(1, SEEN_SIZE)[0]
    rest = body.template + body.shapedirs @ betas
    joints = body.regressor @ rest
    found = np.zeros((len(take.poses), 24))
    for frame, (pose, transl) in enumerate(zip(take.poses, take.transl, strict=True)):
        transforms = bone_transforms(pose, joints, body.parents)
        points = (skin(rest, body.weights, transforms) + transl) @ Y_UP_TO_Z_UP.T
        places = (skin(joints, np.eye(24), transforms) + transl) @ Y_UP_TO_Z_UP.T
        pixels, depth = _project(places, camera)
        before = _depth(points, body.faces, camera) + INSIDE
        if occluder is not None:
            thing = occluder.mesh(width, frame)
            before = np.minimum(before, _depth(thing.vertices, thing.faces, camera))
        column, row = np.clip(pixels.astype(int), 0, SEEN_SIZE - 1).T
        found[frame] = before[row, column] < depth
    smooth = gaussian_filter1d(found, SMOOTH, axis=0, mode="nearest")
    return np.clip(smooth, 0.0, 1.0)  # weights that add up to one do so but for rounding


def _project(points: Floats, camera: StudioCamera) -> tuple[Floats, Floats]:
    local = points @ camera.R.T + camera.T
    pixels = local @ camera.K.T
    return pixels[:, :2] / pixels[:, 2:], local[:, 2]


def _depth(points: Floats, faces: NDArray[np.int64], camera: StudioCamera) -> Floats:
    pixels, depth = _project(points, camera)
    return np.asarray(rasterize_mesh(pixels, depth, faces, SEEN_SIZE, SEEN_SIZE).depth, np.float64)
