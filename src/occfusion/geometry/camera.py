"""Cameras: looking at a target, orbits, projection of vertices. OpenCV axes: x right, y down, z forward."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from occfusion.types import Camera


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Returns the view matrix `[4, 4]` of a camera at `eye` that has `target` in its centre and `up` upwards.

    Args:
        eye: camera centre, `[3]`, metres.
        target: the point looked at, `[3]`, metres.
        up: the direction that points up in the picture, `[3]`; any length, not along the line of sight.

    Raises:
        ValueError: eye and target coincide, or `up` lies along the line of sight.
    """
    forward = target - eye
    right = torch.linalg.cross(forward, up)
    # sine of the angle between the two directions, times their lengths
    if not bool(right.norm() > 1e-6 * forward.norm() * up.norm()):
        raise ValueError(
            f"no camera at {eye.tolist()} looks at {target.tolist()} with {up.tolist()} upwards: "
            "the points coincide or the direction lies along the line of sight"
        )
    forward = functional.normalize(forward, dim=0)
    right = functional.normalize(right, dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4, dtype=eye.dtype, device=eye.device)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ eye
    return viewmat


def square_intrinsics(field_of_view: float, size: int) -> Tensor:
    """Returns `K [3, 3]` of a centred square picture; `field_of_view` in radians, side to side."""
    focal = 0.5 * size / math.tan(0.5 * field_of_view)
    return torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])


def orbit_camera(target: Tensor, angle: float, distance: float, field_of_view: float, size: int) -> Camera:
    """Returns a camera on a horizontal circle around a target, looking at it, with +y upwards.

    Args:
        target: centre of the circle, `[3]`, metres.
        angle: place on the circle in radians, counter-clockwise seen from above. At 0 a body that stands
            along +y and faces +z (SMPL's rest pose) is seen from the front.
        distance: radius in metres.
        field_of_view: of the square picture, radians.
        size: side of the picture in pixels.
    """
    eye = target + distance * target.new_tensor([math.sin(angle), 0.0, math.cos(angle)])
    K = square_intrinsics(field_of_view, size).to(target)
    return Camera(look_at(eye, target, target.new_tensor([0.0, 1.0, 0.0])), K, size, size)


def camera_round(
    camera: Camera, target: Tensor, axis: Tensor, angle: float, *, nearest: float = 0.0
) -> Camera:
    """Returns a camera on the circle round an axis through a target, which it has in the middle of its picture.

    It is as far away and as large as the given one, has the same focal lengths, and the axis points up; where the
    given one is nearer than `nearest`, it is that far away and shows the target as large. The angle begins on the side
    of the given camera; should that look along the axis, on any.

    Args:
        camera: of any type.
        target: centre of the circle, `[3]`, metres; not the camera's own place.
        axis: `[3]`, of any length but 0.
        angle: radians, counter-clockwise for who looks against the axis.
        nearest: metres.
    """
    away = camera.centre.double() - target.double()
    axis = functional.normalize(axis.double(), dim=0)
    out = away - (away @ axis) * axis
    if not bool(out.norm() > 1e-3 * away.norm()):
        least = axis.abs().argmin()
        out = functional.one_hot(least, 3).to(axis) - axis[least] * axis
    out = functional.normalize(out, dim=0)
    side = torch.linalg.cross(axis, out)
    distance = max(float(away.norm()), nearest)
    eye = target.double() + distance * (math.cos(angle) * out + math.sin(angle) * side)
    K = camera.K.double().clone()
    K[:2] *= distance / away.norm()
    K[:2, 2] = K.new_tensor([camera.width / 2, camera.height / 2])
    return Camera(look_at(eye, target.double(), axis), K, camera.width, camera.height)


def project_vertices(
    vertices: NDArray[np.floating], viewmat: NDArray[np.floating], K: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns pixels `[V, 2]` and depths `[V]` of world points; what lies behind the camera keeps its depth."""
    x, y, depth = viewmat[:3, :3] @ vertices.T + viewmat[:3, 3:]  # in rows, which takes half of the time
    away = np.where(depth > 0.01, depth, 1.0)
    x, y = x / away, y / away
    pixels = np.empty((len(depth), 2))
    pixels[:, 0] = K[0, 0] * x + K[0, 1] * y + K[0, 2]
    pixels[:, 1] = K[1, 0] * x + K[1, 1] * y + K[1, 2]
    return pixels, depth
