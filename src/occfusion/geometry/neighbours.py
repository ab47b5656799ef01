"""Nearest neighbours by brute force in blocks: exact, on any device, memory bounded."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_BLOCK_ELEMENTS = 4_000_000
"""Distances held at a time: 32 MB in float64."""


class Neighbours(NamedTuple):
    """The nearest references of each point, nearest first.

    Attributes:
        indices: `[N, k]`, int64.
        distances: `[N, k]`, metres, in the points' dtype.
    """

    indices: Tensor
    distances: Tensor


@torch.no_grad()
def nearest(points: Tensor, references: Tensor, k: int = 1) -> Neighbours:
    """Returns the `k` nearest of `references [M, 3]` to each of `points [N, 3]`; of equal ones any.

    Distances are expanded as |x|^2 - 2 x.y + |y|^2 in float64 around the references' mean, whose rounding
    error (1e-8 m for a body) is far below any spacing that matters.

    Raises:
        ValueError: there are fewer than `k` references.
    """
    if len(references) < k:
        raise ValueError(f"{k} neighbours asked for, but there are only {len(references)} points")
    origin = references.double().mean(dim=0)
    rows, columns = points.double() - origin, references.double() - origin
    half_squares = 0.5 * (columns * columns).sum(dim=1)
    indices, distances = [], []
    for block in rows.split(max(1, _BLOCK_ELEMENTS // len(references))):
        scores = torch.addmm(half_squares, block, columns.T, alpha=-1.0)
        best, index = scores.min(dim=1, keepdim=True) if k == 1 else scores.topk(k, dim=1, largest=False)
        squares = 2 * best + (block * block).sum(dim=1, keepdim=True)
        indices.append(index)
        distances.append(squares.clamp(min=0.0).sqrt())
    if not indices:
        empty = points.new_zeros(0, k)
        return Neighbours(empty.long(), empty)
    return Neighbours(torch.cat(indices), torch.cat(distances).to(points.dtype))


def nearest_others(points: Tensor, k: int = 1) -> Neighbours:
    """Returns the `k` nearest of the *other* points to each of `points [N, 3]`; coinciding points count.

    Raises:
        ValueError: there are not more than `k` points.
    """
    found = nearest(points, points, k + 1)
    own = torch.arange(len(points), device=points.device)[:, None]
    is_self = found.indices == own
    # among coinciding points a row may miss itself; then its last entry is the one too many
    is_self[:, -1] |= ~is_self.any(dim=1)
    keep = ~is_self
    return Neighbours(found.indices[keep].view(-1, k), found.distances[keep].view(-1, k))
