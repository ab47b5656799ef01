"""The capture studio: a ring of 23 cameras, a dark curtain behind, lamps all around. World: z up, metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.synth.rotations import Floats

_SEED = 77  # the rig is the same in all scenes, as a real one is
NOMINAL = 1024  # pixels of the nominal capture
FOCAL = 1100.0  # pixels at the nominal size, about that of ZJU-MoCap
RADIUS, HEIGHT, AIM = 2.65, 1.15, 0.96  # metres: of the ring, of the lenses, of what they look at
RING = 23

Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Carries the body's y-up frame into the world."""

CURTAIN = (9.0, 12.0, 14.0)  # darkest colour behind the person, 0..255


@dataclass(frozen=True)
class StudioCamera:
    """A calibrated camera.

    Attributes:
        place: which of the 23 places of the ring, from 0.
        K: intrinsics, `[3, 3]`, pixels of the written picture.
        R: rotation world to camera, `[3, 3]`.
        T: translation world to camera, `[3]`, metres.
    """

    place: int
    K: Floats
    R: Floats
    T: Floats

    @property
    def name(self) -> str:
        """Returns the folder of its pictures, as in ZJU-MoCap."""
        return f"Camera_B{self.place + 1}"

    @property
    def viewmat(self) -> Floats:
        """Returns world to camera, `[4, 4]`."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.R, self.T
        return out

    @property
    def centre(self) -> Floats:
        """Returns where the camera is, `[3]`, metres."""
        return np.asarray(-self.R.T @ self.T)


def make_cameras(count: int, size: int) -> list[StudioCamera]:
    """Returns the first `count` places of the ring, spread evenly when fewer than all.

    Args:
        count: 1 to 23.
        size: width and height of the pictures, pixels; intrinsics are scaled from the nominal 1024.
    """
    rng = np.random.default_rng(_SEED)
    jitter = rng.uniform(-1.0, 1.0, (RING, 6))
    cameras = []
    for k in range(count):
        place = round(k * RING / count)
        shift = jitter[place]
        angle = 2.0 * np.pi * place / RING + 0.03 * shift[0]
        centre = np.array([np.sin(angle), -np.cos(angle), 0.0]) * (RADIUS + 0.08 * shift[1])
        centre[2] = HEIGHT + 0.12 * shift[2]
        forward = np.array([0.0, 0.0, AIM]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        focal = FOCAL * (1.0 + 0.01 * shift[3])
        K = np.array(
            [
                [focal, 0.0, 0.5 * NOMINAL + 14.0 * shift[4]],
                [0.0, focal, 0.5 * NOMINAL + 14.0 * shift[5]],
                [0.0, 0.0, 1.0],
            ]
        )
        K[:2] *= size / NOMINAL
        cameras.append(StudioCamera(place, K, R, -R @ centre))
    return cameras


def make_background(place: int, size: int) -> NDArray[np.float32]:
    """Returns the empty studio as the camera at a place sees it, `[size, size, 3]`, 0..255."""
    rng = np.random.default_rng([_SEED, place, size])
    x = (np.arange(size) + 0.5) / size
    y = x[:, None]
    phase = rng.uniform(0.0, 6.28, 3)
    folds = sum(
        np.sin(2.0 * np.pi * f * x + p) / k
        for k, (f, p) in enumerate(zip((11, 23, 41), phase, strict=True), 1)
    )
    curtain = 1.0 + 0.25 * folds[None] + 0.3 * (1.0 - y)
    floor = 1.0 / (1.0 + np.exp(-(y - 0.83) / 0.01))
    level = (1.0 - floor) * curtain + floor * (1.5 + 1.2 * (y - 0.83))
    noise = rng.normal(0.0, 0.8, (size, size, 1))
    return np.clip(level[..., None] * np.array(CURTAIN) + noise, 0.0, 255.0).astype(np.float32)
