"""What is wrong with real data: estimated poses and shape that are off, and masks with errors."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.distance import signed_distance
from occfusion.synth.motion import Take, smooth_noise
from occfusion.synth.rotations import Floats, axis_angle_from_quaternion, multiply, quaternion_from_axis_angle

POSE_ERROR = 0.02  # radians for each of the three angles of a joint: 0.035, or 2 degrees, in all
ROOT_ERROR = 0.01  # radians, each angle
PLACE_ERROR = 0.006  # metres along each axis: 1 cm in all
SHAPE_ERROR = 0.3  # standard deviations; of the first component, which is size, a third of it (2 cm)
ERROR_PERIOD = 8.0  # frames over which an estimator's error wanders
RAGGED = 1.4  # pixels at 512 by which an edge is off
RAGGED_WIDTH = 7.0  # pixels at 512 from bump to bump
BITE_CHANCE = 0.3  # how often a mask has a piece missing or too much
BITE_RADIUS = 7.0  # pixels at 512


def disturb_shape(betas: Floats, rng: np.random.Generator) -> Floats:
    """Returns the shape as an estimator would give it, `[10]`."""
    error = SHAPE_ERROR * rng.standard_normal(len(betas))
    error[0] /= 3.0
    return betas + error


def disturb_take(take: Take, rng: np.random.Generator) -> Take:
    """Returns the motion as an estimator would give it: errors smooth in time."""
    frames = len(take.poses)
    error = POSE_ERROR * smooth_noise(rng, frames, 72, ERROR_PERIOD).reshape(frames, 24, 3)
    error[:, 0] *= ROOT_ERROR / POSE_ERROR
    true = quaternion_from_axis_angle(take.poses.reshape(frames, 24, 3))
    poses = axis_angle_from_quaternion(multiply(quaternion_from_axis_angle(error), true))
    transl = take.transl + PLACE_ERROR * smooth_noise(rng, frames, 3, ERROR_PERIOD)
    return Take(poses.reshape(frames, 72), transl)


def person_mask(coverage: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Returns the pixels of which more than half shows the person.

    With four samples a pixel, half is a common tie, and either rule for it would grow or shrink every
    outline by a quarter of a pixel. A touch of the neighbours' coverage tells on which side of the
    middle the edge runs.
    """
    kernel = np.array([1.0, 6.0, 1.0], np.float32) / 8.0
    return np.asarray(cv2.sepFilter2D(coverage, cv2.CV_32F, kernel, kernel) > 0.5)


def disturb_mask(
    coverage: NDArray[np.float32], size: int, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Returns a mask with ragged edges and small errors, and the distances by which its edge was moved.

    Args:
        coverage: share of each pixel that shows the person, `[H, W]`.
        size: width of the whole picture in pixels; errors are in proportion.
        rng: source of the errors.
    """
    scale = size / 512.0
    height, width = coverage.shape
    knots = [int(np.ceil(length / (RAGGED_WIDTH * scale))) + 2 for length in (height, width)]
    bumps = rng.standard_normal(knots).astype(np.float32)
    shift = RAGGED * scale * cv2.resize(bumps, (width, height), interpolation=cv2.INTER_LINEAR)
    person = person_mask(coverage)
    if rng.uniform() < BITE_CHANCE and person.any():
        edge = np.argwhere(person)
        row, column = edge[rng.integers(len(edge))]
        rows, columns = np.ogrid[:height, :width]
        away = np.hypot(rows - row, columns - column)
        radius = BITE_RADIUS * scale * rng.uniform(0.5, 1.0)
        # a bite bends the edge near it; far inside the person it changes nothing, as in real masks
        shift += np.where(away < radius, rng.choice([-1.0, 1.0]) * (radius - away), 0.0).astype(np.float32)
    return move_edge(person, shift), shift


def move_edge(person: NDArray[np.bool_], shift: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Returns the mask with its edge moved outwards by `shift` pixels (inwards where negative)."""
    if not person.any():
        return person
    return np.asarray(signed_distance(person, window=3) + shift > 0.0)
