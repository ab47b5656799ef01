"""Nearest neighbours, exact: by a k-d tree on a CPU, by brute force in blocks elsewhere; memory is bounded."""

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

    Raises:
        ValueError: there are fewer than `k` references, or a number is not finite.
    """
    if len(references) < k:
        raise ValueError(f"{k} neighbours asked for, but there are only {len(references)} points")
    if not (points.isfinite().all() and references.isfinite().all()):
        raise ValueError("neighbours asked for of points that are not all finite")
    if len(points) == 0:
        empty = points.new_zeros(0, k)
        return Neighbours(empty.long(), empty)
    return (by_tree if points.device.type == "cpu" else by_blocks)(points, references, k)


def by_tree(points: Tensor, references: Tensor, k: int) -> Neighbours:
    """Returns what `nearest` does, by a k-d tree in float64 on the CPU."""
    from scipy.spatial import KDTree  # a third of a second, which whoever only draws an avatar need not wait

    tree = KDTree(references.double().numpy())
    # a list of numbers of neighbours keeps their axis where there is but one
    distances, indices = tree.query(points.double().numpy(), k=list(range(1, k + 1)))
    return Neighbours(torch.from_numpy(indices), torch.from_numpy(distances).to(points.dtype))


def by_blocks(points: Tensor, references: Tensor, k: int) -> Neighbours:
    """Returns what `nearest` does, by all distances, on any device.

    Distances are expanded as |x|^2 - 2 x.y + |y|^2 in float64 around the references' mean, whose rounding
    error (1e-8 m for a body) is far below any spacing that matters.
    """
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
