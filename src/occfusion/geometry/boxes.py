"""Pixel rectangles around points and masks."""

from __future__ import annotations

import torch
from torch import Tensor

from occfusion.types import Box, Camera

NEAR = 0.01
"""Metres; points nearer than this to the camera plane have no place in the picture."""


def mask_bounds(mask: Tensor) -> tuple[int, int, int, int] | None:
    """Returns `(left, top, right, bottom)` of the true pixels of a bool `[H, W]`, ends exclusive; None if empty."""
    rows, columns = mask.any(dim=1).nonzero(), mask.any(dim=0).nonzero()
    if rows.numel() == 0:
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def points_bounds(points: Tensor, camera: Camera) -> tuple[int, int, int, int] | None:
    """Returns `(left, top, right, bottom)` in pixels of projected points `[N, 3]`, ends exclusive.

    The bounds are not cut to the picture; None if all points lie behind the camera.
    """
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    local = local[local[:, 2] > NEAR]
    if local.shape[0] == 0:
        return None
    pixels = (local[:, :2] / local[:, 2:]) @ camera.K[:2, :2].T + camera.K[:2, 2]
    # beyond this the exact value no longer matters, and int() of it stays small
    pixels = pixels.clamp(-1e6, 1e6)
    low, high = pixels.amin(dim=0).floor(), pixels.amax(dim=0).ceil()
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def person_box(points: Tensor, mask: Tensor, camera: Camera, padding: int) -> Box:
    """Returns the padded rectangle that holds both the projected points and the mask, cut to the picture.

    Args:
        points: `[N, 3]`, metres, world.
        mask: bool `[H, W]`.
        camera: whose picture it is.
        padding: pixels on each side.

    The whole picture is returned when neither gives a rectangle inside it.
    """
    bounds = [b for b in (points_bounds(points, camera), mask_bounds(mask)) if b is not None]
    whole = (0, 0, camera.width, camera.height)
    if not bounds:
        return whole
    left, top = (max(0, min(b[k] for b in bounds) - padding) for k in (0, 1))
    right = min(camera.width, max(b[2] for b in bounds) + padding)
    bottom = min(camera.height, max(b[3] for b in bounds) + padding)
    if right <= left or bottom <= top:
        return whole
    return left, top, right - left, bottom - top


def crop(image: Tensor, box: Box) -> Tensor:
    """Returns the window `box` of a picture `[H, W, ...]` as a view."""
    x, y, w, h = box
    return torch.narrow(torch.narrow(image, 0, y, h), 1, x, w)
