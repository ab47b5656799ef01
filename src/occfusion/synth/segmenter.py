"""Masks as a segmenter gives them: errors that stay for several frames, at the edge and of whole hands or feet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.synth.motion import smooth_noise
from occfusion.synth.rotations import Floats

EDGE_ERROR = 1.6  # pixels at 512: standard deviation by which an edge is off
BUMP_WIDTH = 12.0  # pixels at 512 from bump to bump
LASTING = 6.0  # frames over which an edge's error wanders
EVENTS = 0.06  # a frame and camera: how often an end of the body begins to be missed or widened
SHORTEST, LONGEST = 3, 12  # frames that this lasts
SMALLEST, LARGEST = 7.0, 18.0  # pixels at 512: radius
MISSED = 0.65  # share of events in which something is missing; in the others there is too much
ENDS = (4, 5, 7, 8, 10, 11, 15, 18, 19, 20, 21, 22, 23)
"""Joints near which events are: knees, feet, head, elbows, hands."""


@dataclass(frozen=True)
class Event:
    """Something missed or too much, for a while.

    Attributes:
        first: its first frame.
        last: its last frame.
        joint: of `ENDS`, where it is.
        radius: pixels of the picture.
        sign: -1 missing, +1 too much.
    """

    first: int
    last: int
    joint: int
    radius: float
    sign: float


class Segmenter:
    """The errors of the masks of one camera.

    Args:
        size: width of the pictures, pixels.
        frames: of the scene.
        rng: source of the errors.
    """

    def __init__(self, size: int, frames: int, rng: np.random.Generator) -> None:
        self._scale = size / 512.0
        knots = int(np.ceil(size / (BUMP_WIDTH * self._scale))) + 2
        bumps = smooth_noise(rng, frames, knots * knots, LASTING).astype(np.float32)
        self._bumps = bumps.reshape(-1, knots, knots)
        self.events = _events(self._scale, frames, rng)

    def edge_shift(self, frame: int) -> NDArray[np.float32]:
        """Returns how far outwards the edge is off at knots all over the picture, `[K, K]`, pixels."""
        return np.asarray(EDGE_ERROR * self._scale * self._bumps[frame], np.float32)

    def shift(
        self, frame: int, part: tuple[slice, slice], place: Callable[[int], Floats]
    ) -> NDArray[np.float32]:
        """Returns by how many pixels the edge moves outwards in a part of the picture, `[h, w]`.

        Args:
            frame: number of the frame.
            part: rows and columns.
            place: returns the pixel of a joint, `[2]`.
        """
        rows, columns = (np.arange(own.start, own.stop) for own in part)
        pitch = BUMP_WIDTH * self._scale
        grid_x, grid_y = np.meshgrid((columns / pitch).astype(np.float32), (rows / pitch).astype(np.float32))
        shift = cv2.remap(
            self.edge_shift(frame), grid_x, grid_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        for event in self.events:
            if event.first <= frame <= event.last:
                x, y = place(event.joint)
                away = np.hypot(rows[:, None] + 0.5 - y, columns + 0.5 - x)
                moved = np.where(away < event.radius, event.sign * 2.0 * (event.radius - away), 0.0)
                shift += moved.astype(np.float32)
        return np.asarray(shift, np.float32)


def _events(scale: float, frames: int, rng: np.random.Generator) -> list[Event]:
    found = []
    for first in range(-LONGEST, frames):  # those before the first frame may last into it
        if rng.uniform() < EVENTS:
            last = first + int(rng.integers(SHORTEST, LONGEST + 1)) - 1
            sign = -1.0 if rng.uniform() < MISSED else 1.0
            radius = scale * float(rng.uniform(SMALLEST, LARGEST))
            found.append(Event(first, last, int(rng.choice(ENDS)), radius, sign))
    return found
