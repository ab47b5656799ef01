"""The made-up person as an inpainter is given it: a blue coarse rendering of what is hidden and seen."""

import dataclasses

import numpy as np
import torch

from made_up_person import made_up_observation
from occfusion.inpaint.partial import Partial
from occfusion.types import Camera

COARSE = (0.1, 0.3, 0.8)


def made_up_partial(size: int = 96, name: str = "frame 000003", beside: int = 0) -> Partial:
    """Whole below the rim, half transparent in the rim's columns; the person stands `beside` pixels to the left."""
    seen = made_up_observation(size, name)
    camera = seen.camera
    K = camera.K.clone()
    K[0, 2] -= beside
    visible, rgb = np.roll(seen.visible, -beside, axis=1), np.roll(seen.rgb, -beside, axis=1)
    visible[:, size - beside :], rgb[:, size - beside :] = False, 0.0
    observation = dataclasses.replace(
        seen, camera=Camera(camera.viewmat, K, size, size), visible=visible, rgb=rgb
    )
    alpha = np.zeros((size, size), np.float32)
    left, right = (max(int(share * size) - beside, 0) for share in (0.38, 0.63))
    rows = slice(int(0.2 * size), int(0.8 * size))
    alpha[rows, left:right] = 1.0
    alpha[rows, left : left + 2] = 0.8
    alpha[rows, right : right + 2] = 0.5
    coarse = (alpha[..., None] * np.array(COARSE)).astype(np.float32)
    complete = alpha > 0.4
    return Partial(observation, complete, coarse, alpha, lambda: coarse, alpha)


def only_region(partial: Partial, kept: np.ndarray) -> Partial:
    """Returns the frame with occupancy, and so the region to paint, in some pixels only."""
    alpha = np.where(kept, partial.alpha, 0.0).astype(np.float32)
    return dataclasses.replace(partial, alpha=alpha, coarse=np.where(kept[..., None], partial.coarse, 0.0))


def painted_like(generator: int, height: int, width: int) -> np.ndarray:
    """Returns noise, `[height, width, 3]`, 0..1."""
    draw = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(generator))
    return draw.numpy()
