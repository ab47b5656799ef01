"""Known mistakes in cameras: which of them would explain that body and mask do not meet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from occfusion.data import overlap
from occfusion.data.scene import Array, Calibration

BETTER = 0.15
"""By how much more IoU a mistake has to explain the data to be named."""

FLIP = np.diag([1.0, -1.0, -1.0])

MISTAKES: dict[str, Callable[[Calibration], Calibration]] = {
    "R is transposed (camera to world)": lambda c: replace(c, R=c.R.T),
    "R and T are the camera's place, not world to camera": lambda c: replace(c, R=c.R.T, t=-c.R.T @ c.t),
    "T is the camera's centre": lambda c: replace(c, t=-c.R @ c.t),
    "T is 1000 times too large (millimetres)": lambda c: replace(c, t=c.t / 1000),
    "T is 1000 times too small (metres read as millimetres)": lambda c: replace(c, t=c.t * 1000),
    "camera axes are OpenGL's (y up, z backward)": lambda c: replace(c, R=FLIP @ c.R, t=FLIP @ c.t),
}
"""Mistakes seen in data of this field, as what would undo them."""


def explain(
    vertices: Sequence[Array],
    masks: Sequence[NDArray[np.bool_]],
    cameras: Calibration | Sequence[Calibration],
) -> str:
    """Returns a sentence naming the mistake whose undoing makes body and masks meet; empty when none does.

    Args:
        vertices: the body in the world in some frames, each `[V, 3]`, metres.
        masks: the person in the same frames, each `[H, W]`.
        cameras: the camera as it was read; one a frame where its lens zoomed.
    """
    read = [cameras] * len(masks) if isinstance(cameras, Calibration) else cameras

    def fit(undo: Callable[[Calibration], Calibration]) -> float:
        views = zip(vertices, read, masks, strict=True)
        return float(
            np.mean([overlap.mask_overlap(body, undo(camera), mask)[0] for body, camera, mask in views])
        )

    best, reason = fit(lambda camera: camera) + BETTER, ""
    for name, undo in MISTAKES.items():
        score = fit(undo)
        if score > best:
            best, reason = score, name
    return f"it seems that {reason}: undone, the IoU is {best:.2f}" if reason else ""
