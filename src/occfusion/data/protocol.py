"""Which frames and cameras are trained on and which are held out."""

from __future__ import annotations

from collections.abc import Sequence

from occfusion.errors import ConfigError

TRAIN_FRAMES = 100
"""The paper trains on 100 frames of each ZJU-MoCap sequence, 0 to 495."""

MAX_STEP = 5
TEST_EVERY = 6
"""Held-out moments are every sixth training frame: 0 to 480 by 30 on ZJU-MoCap."""


def paper_step(num_frames: int) -> int:
    """Returns the distance of the paper's training frames, 5, less for sequences shorter than 500."""
    return min(max(num_frames // TRAIN_FRAMES, 1), MAX_STEP)


def train_range(spec: Sequence[int | None] | None, num_frames: int) -> tuple[int, ...]:
    """Returns the training frames: `spec` as `[start, stop, step]`, or the paper's when None."""
    step = paper_step(num_frames)
    return frame_range(spec, (0, TRAIN_FRAMES * step, step), num_frames, "dataset.train_frames")


def held_out_range(spec: Sequence[int | None] | None, num_frames: int) -> tuple[int, ...]:
    """Returns the held-out frames: `spec` as `[start, stop, step]`, or the paper's when None."""
    step = paper_step(num_frames)
    return frame_range(spec, (0, TRAIN_FRAMES * step, TEST_EVERY * step), num_frames, "dataset.test_frames")


def frame_range(
    spec: Sequence[int | None] | None, default: tuple[int, int, int], num_frames: int, key: str
) -> tuple[int, ...]:
    """Returns the frames of `[start, stop, step]`, cut to those that exist; a null stop means the end.

    Raises:
        ConfigError: not three integers, a negative start, a step below 1, or no frame left.
    """
    if spec is None:
        start, stop, step = default
    else:
        parts = list(spec) if isinstance(spec, Sequence) and not isinstance(spec, str) else None
        if parts is None or len(parts) != 3:
            raise ConfigError(f"{key}={spec!r}: give [start, stop, step], for example [0, 500, 5], or null.")
        if parts[1] is None:
            parts[1] = num_frames
        if any(isinstance(p, bool) or not isinstance(p, int) for p in parts):
            raise ConfigError(f"{key}={spec!r}: start, stop and step must be whole numbers.")
        start, stop, step = (int(p) for p in parts if p is not None)
    if start < 0 or step < 1:
        raise ConfigError(f"{key}={spec!r}: start must be at least 0 and step at least 1.")
    frames = tuple(range(start, min(stop, num_frames), step))
    if not frames:
        raise ConfigError(f"{key}={spec!r}: selects nothing; the scene has the frames 0..{num_frames - 1}.")
    return frames


def held_out_cameras(spec: Sequence[int] | None, train_camera: int, count: int) -> tuple[int, ...]:
    """Returns the test cameras: `spec`, or all but the training camera when None.

    Raises:
        ConfigError: a camera does not exist or is named twice.
    """
    if isinstance(train_camera, bool) or not isinstance(train_camera, int) or not 0 <= train_camera < count:
        raise ConfigError(
            f"dataset.train_camera={train_camera!r}: the scene has the cameras 0..{count - 1}. Choose one of them; "
            "where it is not set, dataset.protocol chooses."
        )
    if spec is None:
        return tuple(camera for camera in range(count) if camera != train_camera)
    if isinstance(spec, str) or not isinstance(spec, Sequence):
        raise ConfigError(
            f"dataset.test_cameras={spec!r}: give a list of indices, or null for all the others."
        )
    if any(isinstance(c, bool) or not isinstance(c, int) or not 0 <= c < count for c in spec):
        raise ConfigError(f"dataset.test_cameras={list(spec)!r}: the scene has the cameras 0..{count - 1}.")
    if len(set(spec)) != len(spec):
        raise ConfigError(f"dataset.test_cameras={list(spec)!r}: a camera is named twice.")
    return tuple(spec)
