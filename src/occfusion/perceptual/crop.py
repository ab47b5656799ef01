"""Where a training step's perceptual term looks."""

from __future__ import annotations

import torch
from torch import Tensor

from occfusion.types import Box


def random_crop_box(mask: Tensor, size: int, generator: torch.Generator) -> Box:
    """Returns a window of `size` px around a random pixel of `mask`, cut to the picture.

    The window is moved into the mask's bounding box where it is larger than the window, so that no training
    step is spent on background, and into the picture in any case. An empty mask gives the middle of the
    picture.

    Args:
        mask: the person, bool `[H, W]`.
        size: side in pixels; smaller where the picture is.
        generator: source of the choice (on the CPU).
    """
    height, width = mask.shape
    pixels = mask.nonzero()
    if len(pixels) == 0:
        row, column = height // 2, width // 2
        first, last = [0, 0], [height - 1, width - 1]
    else:
        row, column = pixels[int(torch.randint(len(pixels), (1,), generator=generator))].tolist()
        first, last = pixels.amin(dim=0).tolist(), pixels.amax(dim=0).tolist()
    y, h = _place(row, size, first[0], last[0] + 1, height)
    x, w = _place(column, size, first[1], last[1] + 1, width)
    return x, y, w, h


def _place(centre: int, size: int, start: int, stop: int, length: int) -> tuple[int, int]:
    """Returns start and length of a window on one axis: around `centre`, in [start, stop), in [0, length)."""
    size = min(size, length)
    first = centre - size // 2
    if stop - start >= size:
        first = min(max(first, start), stop - size)
    return min(max(first, 0), length - size), size
