"""A clip: body poses over time in a world of their own, at a known rate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import ConfigError
from occfusion.synth.rotations import axis_angle_from_quaternion, quaternion_from_axis_angle, slerp

Array = NDArray[np.float64]

USUAL_FPS = 24.0
"""Frames a second that a clip is played with where nobody says."""
MOST_FRAMES = 20_000
"""Frames of a clip after it was resampled; eleven minutes at 30 a second."""


@dataclass(frozen=True)
class Clip:
    """Poses over time, in the conventions of smplx.

    Attributes:
        name: what messages and pages call it.
        global_orient: `[T, 3]`, radians.
        body_pose: `[T, 69]`, radians.
        transl: `[T, 3]`, metres.
        fps: frames a second; None where nobody says.
        up: the axis of the clip's world that is up, as `y` or `-z`.
        betas: shape of whoever moved, `[B]`, for the body that is going to move too; None: of another body.
        numbers: numbers of the frames in the sequence that an avatar learned from, `[T]`; None: of another sequence.
    """

    name: str
    global_orient: Array
    body_pose: Array
    transl: Array
    fps: float | None
    up: str
    betas: Array | None = None
    numbers: Array | None = None

    def __len__(self) -> int:
        """Returns the number of frames."""
        return len(self.global_orient)

    @property
    def up_direction(self) -> Array:
        """The direction that is up, `[3]`."""
        direction = np.zeros(3)
        direction["xyz".index(self.up[-1])] = -1.0 if self.up[0] == "-" else 1.0
        return direction

    def at(self, places: Array) -> Clip:
        """Returns the clip at places between its frames, `[S]`, 0 to T - 1; joints turn the shorter way."""
        left = np.clip(np.floor(places).astype(int), 0, max(len(self) - 2, 0))
        right = np.minimum(left + 1, len(self) - 1)
        share = places - left
        turns = np.concatenate([self.global_orient, self.body_pose], axis=1).reshape(len(self), -1, 3)
        quaternions = quaternion_from_axis_angle(turns)
        mixed = axis_angle_from_quaternion(slerp(quaternions[left], quaternions[right], share[:, None]))
        # where nothing lies between, the very numbers stay: an axis-angle may be longer than a half turn
        mixed = np.where((share == 0.0)[:, None, None], turns[left], mixed)
        return replace(
            self,
            global_orient=mixed[:, 0],
            body_pose=mixed[:, 1:].reshape(len(places), -1),
            transl=_mixed(self.transl, left, right, share[:, None]),
            numbers=None if self.numbers is None else _mixed(self.numbers, left, right, share),
        )

    def resampled(self, fps: float) -> Clip:
        """Returns the clip at another rate, as long as before; at its own rate it is as it was.

        Raises:
            ConfigError: its own rate is not known, or it would have too many frames.
        """
        if self.fps is None:
            raise ConfigError(
                f"motion {self.name}: nothing says how many frames a second it has; give it with --motion-fps"
            )
        if fps == self.fps:
            return self
        count = int((len(self) - 1) * fps / self.fps + 1e-9) + 1
        if count > MOST_FRAMES:
            raise ConfigError(
                f"motion {self.name}: {count} frames at {fps:g} a second, {MOST_FRAMES} is the most; "
                "take a part of it with --start and --seconds"
            )
        return replace(self.at(np.arange(count, dtype=np.float64) * (self.fps / fps)), fps=fps)

    def part(self, start: float, seconds: float | None) -> Clip:
        """Returns the part from `start` seconds on, `seconds` long (None: to the end).

        Raises:
            ConfigError: nothing is left, or times are asked for where the rate is not known.
        """
        if start == 0.0 and seconds is None:
            return self
        if self.fps is None:
            raise ConfigError(
                f"motion {self.name}: nothing says how many frames a second it has; give it with --motion-fps"
            )
        first = round(start * self.fps)
        last = len(self) if seconds is None else first + max(round(seconds * self.fps), 1)
        if first < 0 or first >= min(last, len(self)):
            raise ConfigError(
                f"motion {self.name} lasts {len(self) / self.fps:.2f} s; --start {start:g} leaves nothing of it"
            )
        return self[first:last]

    def __getitem__(self, rows: slice) -> Clip:
        """Returns some frames of the clip."""
        return replace(
            self,
            global_orient=self.global_orient[rows],
            body_pose=self.body_pose[rows],
            transl=self.transl[rows],
            numbers=None if self.numbers is None else self.numbers[rows],
        )


def _mixed(values: Array, left: NDArray[np.int64], right: NDArray[np.int64], share: Array) -> Array:
    return (1.0 - share) * values[left] + share * values[right]
