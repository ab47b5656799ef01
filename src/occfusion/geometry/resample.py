"""Resampling a picture to another grid as two matrices, so that it is exact and differentiable."""

from __future__ import annotations

import torch
from torch import Tensor

from occfusion.types import Box


def averaging_matrix(start: float, side: float, size: int, first: int, count: int) -> Tensor:
    """Returns the matrix that averages a row of pixels over the intervals of another grid, `[size, count]`, float32.

    Interval j is `start + [j, j + 1] side / size`; between pixel centres, which lie at +0.5, the row is linear, and
    it is zero beyond its ends. The average is exact whether the new pixels are larger or smaller.

    Args:
        start: where the first interval begins, pixels.
        side: length of all intervals, pixels.
        size: number of intervals.
        first: place of the row's first pixel.
        count: pixels of the row.
    """
    edges = start + side / size * torch.arange(size + 1, dtype=torch.float64)
    centres = first + 0.5 + torch.arange(count, dtype=torch.float64)
    apart = (edges[:, None] - centres).clamp(-1.0, 1.0)
    below = 0.5 + apart * (1.0 - 0.5 * apart.abs())  # integral of the tent of width 2 up to each edge
    return ((below[1:] - below[:-1]) * (size / side)).float()


def take_square(window: Tensor, box: Box, x: float, y: float, side: float, size: int) -> Tensor:
    """Returns a square of a picture that is known in a window, each new pixel averaged over its area.

    Differentiable in `window`; the picture is zero outside it.

    Args:
        window: `[h, w]`.
        box: where it lies in the picture.
        x: left edge of the square, pixels of the picture; may lie outside it.
        y: its upper edge.
        side: its width and height.
        size: pixels a side of the result.
    """
    left, top, width, height = box
    rows = averaging_matrix(y, side, size, top, height).to(window)
    columns = averaging_matrix(x, side, size, left, width).to(window)
    return rows @ window @ columns.T
