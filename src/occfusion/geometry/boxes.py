"""Pixel rectangles around points and masks."""

from __future__ import annotations

import torch
from torch import Tensor

from occfusion.gpu.graphs import GraphedFunction
from occfusion.types import Box, Camera

Bounds = tuple[int, int, int, int]
"""Left, top, right, bottom in pixels, ends exclusive."""
NEAR = 0.01
"""Metres; points nearer than this to the camera plane have no place in the picture."""

FARTHEST = 1e6
"""Pixels beyond which the exact place no longer matters; `int` of it stays small."""


def mask_bounds(mask: Tensor) -> tuple[int, int, int, int] | None:
    """Returns `(left, top, right, bottom)` of the true pixels of a bool `[H, W]`, ends exclusive; None if empty."""
    rows, columns = mask.any(dim=1).nonzero(), mask.any(dim=0).nonzero()
    if rows.numel() == 0:
        return None
    left, right, top, bottom = torch.cat([columns[0], columns[-1], rows[0], rows[-1]]).tolist()
    return left, top, right + 1, bottom + 1


def points_bounds(points: Tensor, camera: Camera) -> tuple[int, int, int, int] | None:
    """Returns `(left, top, right, bottom)` in pixels of projected points `[N, 3]`, ends exclusive.

    The bounds are not cut to the picture; None if all points lie behind the camera.
    """
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    local = local[local[:, 2] > NEAR]
    if local.shape[0] == 0:
        return None
    pixels = (local[:, :2] / local[:, 2:]) @ camera.K[:2, :2].T + camera.K[:2, 2]
    pixels = pixels.clamp(-FARTHEST, FARTHEST)
    left, top, right, bottom = torch.cat([pixels.amin(dim=0).floor(), pixels.amax(dim=0).ceil()]).tolist()
    return int(left), int(top), int(right), int(bottom)


def person_box(points: Tensor, mask: Tensor, camera: Camera, padding: int, *, compiled: bool = False) -> Box:
    """Returns the padded rectangle that holds both the projected points and the mask, cut to the picture.

    Args:
        points: `[N, 3]`, metres, world.
        mask: bool `[H, W]`.
        camera: whose picture it is.
        padding: pixels on each side.
        compiled: by the kernels of `box_kernels.py`, where they take the points: float32 on a CPU. A place that
            rounding carries over a whole pixel may move a side by that pixel.

    The whole picture is returned when neither gives a rectangle inside it.
    """
    if compiled and points.dtype == torch.float32 and points.device.type == "cpu":
        both = _compiled_bounds(points, mask, camera)
    elif points.is_cuda:
        both = _bounds_at_once(points, mask, camera)
    else:
        both = (points_bounds(points, camera), mask_bounds(mask))
    bounds = [b for b in both if b is not None]
    whole = (0, 0, camera.width, camera.height)
    if not bounds:
        return whole
    left, top = (max(0, min(b[k] for b in bounds) - padding) for k in (0, 1))
    right = min(camera.width, max(b[2] for b in bounds) + padding)
    bottom = min(camera.height, max(b[3] for b in bounds) + padding)
    if right <= left or bottom <= top:
        return whole
    return left, top, right - left, bottom - top


def _compiled_bounds(points: Tensor, mask: Tensor, camera: Camera) -> tuple[Bounds | None, Bounds | None]:
    """Returns `points_bounds` and `mask_bounds`."""
    # numba is loaded where it is used
    from occfusion.geometry.box_kernels import bounds_of_mask, bounds_of_points

    viewmat, K = (tensor.to(points).contiguous().numpy() for tensor in (camera.viewmat, camera.K))
    count, *of_points = bounds_of_points(points.contiguous().numpy(), viewmat, K, NEAR, FARTHEST)
    of_mask = bounds_of_mask(mask.contiguous().numpy())
    left, top, right, bottom = of_points
    return (left, top, right, bottom) if count else None, of_mask if of_mask[2] else None


def _bounds_at_once(points: Tensor, mask: Tensor, camera: Camera) -> tuple[Bounds | None, Bounds | None]:
    """Returns `points_bounds` and `mask_bounds`, asking the device once."""
    viewmat, K = camera.viewmat.to(points), camera.K.to(points)
    found = _GRAPHED_BOUNDS(points, mask, viewmat, K)[0].tolist()
    left, top, right, bottom, *of_mask, count = map(int, found)
    of_points = (left, top, right, bottom) if right > -FARTHEST - 1 else None
    return of_points, (of_mask[0], of_mask[1], of_mask[2], of_mask[3]) if count else None


def _bounds(points: Tensor, mask: Tensor, viewmat: Tensor, K: Tensor) -> tuple[Tensor]:
    """Returns the four bounds of points, those of a mask, and whether there is any pixel in it, in double precision."""
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    is_before = local[:, 2:] > NEAR
    pixels = (local[:, :2] / torch.where(is_before, local[:, 2:], 1.0)) @ K[:2, :2].T + K[:2, 2]
    pixels = pixels.clamp(-FARTHEST, FARTHEST)
    beyond = 2 * FARTHEST
    low = torch.where(is_before, pixels, beyond).amin(dim=0).floor()
    high = torch.where(is_before, pixels, -beyond).amax(dim=0).ceil()
    ends = []
    for line in (mask.any(dim=0), mask.any(dim=1)):
        flags = line.to(torch.int8)  # of equal numbers the first is found
        ends.append(torch.stack([flags.argmax(), len(line) - flags.flip(0).argmax()]))
    of_mask = torch.stack(ends, dim=1).flatten()
    return (torch.cat([low.double(), high.double(), of_mask.double(), mask.any().double()[None]]),)


_GRAPHED_BOUNDS = GraphedFunction(_bounds)


def crop(image: Tensor, box: Box) -> Tensor:
    """Returns the window `box` of a picture `[H, W, ...]` as a view."""
    x, y, w, h = box
    return torch.narrow(torch.narrow(image, 0, y, h), 1, x, w)
