"""A person of two boxes in front of a camera, cheap to make, with key points where a person has them."""

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.observation.frames import Observation
from occfusion.types import Camera

# x to the wearer's left (the picture's right), y down from the head, in heights of a person who faces the camera
FRONT = np.array([
    (0.00, 0.07), (0.00, 0.18), (-0.12, 0.18), (-0.17, 0.33), (-0.20, 0.47), (0.12, 0.18), (0.17, 0.33), (0.20, 0.47),
    (-0.07, 0.52), (-0.08, 0.74), (-0.08, 0.95), (0.07, 0.52), (0.08, 0.74), (0.08, 0.95), (-0.02, 0.05), (0.02, 0.05),
    (-0.05, 0.06), (0.05, 0.06),
])  # fmt: skip
HEIGHT, DISTANCE = 1.7, 4.0
_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (0, 1) for z in (-1, 1)], float)
_QUADS = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
FACES = np.array([t for a, b, c, d in _QUADS for t in ((a, b, c), (a, c, d))], np.int64)


def made_up_camera(size: int) -> Camera:
    """A camera in whose picture the person is 0.6 of its height."""
    focal = 0.6 * size * DISTANCE / HEIGHT
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(torch.eye(4, dtype=torch.float64), K, size, size)


def in_front(points: NDArray[np.floating], depth: float = DISTANCE) -> NDArray[np.float64]:
    """Returns points of the person's plane, in heights, in the world, metres."""
    flat = HEIGHT * (points - (0.0, 0.5))
    return np.concatenate([flat, np.full((len(flat), 1), depth)], axis=1)


def made_up_observation(size: int = 96, name: str = "frame 000003") -> Observation:
    """The person's right half is hidden; the rest is red."""
    scale = HEIGHT * np.array([0.22, 1.0, 0.0]) + (0, 0, 0.12)
    vertices = _CORNERS * scale + (0.0, -0.5 * HEIGHT, DISTANCE)
    visible = np.zeros((size, size), bool)
    visible[int(0.2 * size) : int(0.8 * size), size // 2 : int(0.63 * size)] = True
    rgb = np.zeros((size, size, 3), np.float32)
    rgb[visible] = (0.9, 0.2, 0.1)
    background = np.zeros((size, size), bool)
    background[:, int(0.9 * size) :] = True
    return Observation(
        name,
        rgb,
        visible,
        background,
        made_up_camera(size),
        vertices,
        in_front(FRONT, DISTANCE - 0.12),
        FACES,
    )
