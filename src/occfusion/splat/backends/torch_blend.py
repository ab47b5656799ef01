"""Front-to-back blending of tile lists and its gradient, in plain PyTorch.

For one pixel and splats i = 1, 2, ... in order of depth, with transmittance T_1 = 1:

    alpha_i = min(opacity_i exp(-(u_i^2 + v_i^2) / 2), alpha_max), or 0 when below alpha_min
    T_{i+1} = T_i (1 - alpha_i)
    w_i     = T_i alpha_i while T_i >= stop, else 0
    picture = sum_i w_i f_i,   f = (red, green, blue, depth, 1).

With g the gradient of the picture and s_i = g . f_i, the gradient of alpha_i is
T_i s_i - (sum_{j > i} w_j s_j) / (1 - alpha_i); alphas that were capped or dropped have none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from occfusion.splat.limits import Limits
from occfusion.splat.tiles import TileLists, picture_to_tiles, tiles_to_picture
from occfusion.types import Box

CHUNK = 150_000
"""Elements (tile x splat x pixel) blended at once: the working arrays of a chunk stay in the cache.
Measured at 50 k, 150 k and 400 k elements: 87, 77 and 92 ms for forward and backward."""

CHANNELS = 5
"""Features a splat carries through the blend: three of colour, its depth, and 1 for alpha."""


@dataclass(frozen=True)
class Chunk:
    """Some tiles of similar list length, padded to the longest.

    Attributes:
        rows: the tiles' rows in the tile lists (and in the stacked output).
        pairs: `[B, L]` positions in `TileLists.splats`; padding points past its end.
        splats: `[B, L]` positions of splats; padding points at a splat of opacity zero.
        px: pixel centres of each tile's columns, `[B, 1, S]`, full-picture pixels.
        py: pixel centres of each tile's rows, `[B, 1, S]`.
    """

    rows: slice
    pairs: Tensor
    splats: Tensor
    px: Tensor
    py: Tensor


def chunks(lists: TileLists, crop: Box, padding: int, dtype: torch.dtype) -> Iterator[Chunk]:
    """Yields the tiles of the lists in chunks of about `CHUNK` elements; `padding` is the empty splat."""
    size, device = lists.size, lists.splats.device
    counts = lists.counts.tolist()
    padded = torch.cat([lists.splats, lists.splats.new_full((1,), padding)])
    step = torch.arange(size, device=device, dtype=dtype) + 0.5
    left = (lists.tiles % lists.across) * size + crop[0]
    top = torch.div(lists.tiles, lists.across, rounding_mode="floor") * size + crop[1]
    begin = 0
    while begin < len(counts):
        longest = counts[begin]  # lists are sorted by length
        end = min(len(counts), begin + max(1, CHUNK // (longest * size * size)))
        rows = slice(begin, end)
        rank = torch.arange(longest, device=device)
        pairs = lists.starts[rows, None] + rank
        pairs = torch.where(rank < lists.counts[rows, None], pairs, len(lists.splats))
        px = (left[rows, None].to(dtype) + step)[:, None, :]
        py = (top[rows, None].to(dtype) + step)[:, None, :]
        yield Chunk(rows, pairs, padded[pairs], px, py)
        begin = end


@dataclass(frozen=True)
class Blended:
    """Intermediate values of a chunk; `[B, L, S, S]` unless said otherwise.

    Attributes:
        dx: pixel minus splat centre, `[B, L, S]`; columns.
        dy: the same for rows, `[B, L, S]`.
        u: first whitened coordinate.
        v: second whitened coordinate, the same for a whole row, `[B, L, S]`.
        alpha: as blended: capped, zero when dropped.
        through: what the splats before let through one by one: 1, then 1 - alpha of the one before.
        transmittance: in front of each splat; zero once blending has stopped.
    """

    dx: Tensor
    dy: Tensor
    u: Tensor
    v: Tensor
    alpha: Tensor
    through: Tensor
    transmittance: Tensor


def blend_chunk(chunk: Chunk, shapes: Tensor, limits: Limits, is_capped: bool) -> Blended:
    """Returns alphas and transmittances.

    `is_capped`: whether any opacity reaches `alpha_max`.
    `shapes` `[V + 1, 8]` is the centre's whole pixels x, y, the rest of it, l1, m, l2, log opacity. The difference
    of a pixel and whole pixels is exact, so the distance is as exact at the far corner as at the first.
    """
    whole_x, whole_y, part_x, part_y, l1, m, l2, log_opacity = (
        rows_of(shapes, chunk.splats).unsqueeze(-1).unbind(2)
    )
    dx, dy = (chunk.px - whole_x) - part_x, (chunk.py - whole_y) - part_y
    v = l2 * dy
    u = (l1 * dx)[:, :, None, :] + (m * dy)[:, :, :, None]
    row_term = torch.addcmul(log_opacity, v, v, value=-0.5)
    alpha = torch.addcmul(row_term[:, :, :, None], u, u, value=-0.5).exp_()
    torch.threshold_(alpha, limits.alpha_min, 0.0)
    if is_capped:
        alpha.clamp_(max=limits.alpha_max)
    through = torch.empty_like(alpha)
    through[:, 0] = 1
    torch.sub(1, alpha[:, :-1], out=through[:, 1:])
    transmittance = torch.threshold_(through.cumprod(dim=1), limits.stop, 0.0)
    return Blended(dx, dy, u, v, alpha, through, transmittance)


class Blend(torch.autograd.Function):
    """Blends tile lists into a picture; the gradient is analytic and recomputes each chunk."""

    @staticmethod
    def forward(ctx, means2d, factors, opacities, features, lists, crop, limits):  # type: ignore[no-untyped-def]
        """Returns rgb `[h, w, 3]`, alpha and weighted depth `[h, w]`; `features` are `[V, 5]`."""
        shapes, padded = _with_padding(means2d, factors, opacities, features)
        is_capped = bool((opacities >= limits.alpha_max).any())
        stacked = features.new_empty(len(lists.tiles), CHANNELS, lists.size**2)
        for chunk in chunks(lists, crop, len(opacities), opacities.dtype):
            blended = blend_chunk(chunk, shapes, limits, is_capped)
            weights = blended.transmittance.mul_(blended.alpha).flatten(2)
            torch.bmm(rows_of(padded, chunk.splats).transpose(1, 2), weights, out=stacked[chunk.rows])
        ctx.save_for_backward(means2d, factors, opacities, features)
        ctx.plan = lists, crop, limits, is_capped
        ctx.set_materialize_grads(False)
        return tiles_to_picture(stacked, lists, crop)

    @staticmethod
    def backward(ctx, grad_rgb, grad_alpha, grad_depth):  # type: ignore[no-untyped-def]
        """Returns the gradients of means2d, factors, opacities and features."""
        means2d, factors, opacities, features = ctx.saved_tensors
        lists, crop, limits, is_capped = ctx.plan
        grad = picture_to_tiles(grad_rgb, grad_alpha, grad_depth, lists, crop, opacities)
        shapes, padded = _with_padding(means2d, factors, opacities, features)
        grad_shapes = grad.new_zeros(len(lists.splats) + 1, 6)
        grad_features = grad.new_zeros(len(lists.splats) + 1, CHANNELS)
        for chunk in chunks(lists, crop, len(opacities), opacities.dtype):
            shape_part, feature_part = _chunk_gradients(
                chunk, shapes, padded, grad[chunk.rows], limits, is_capped
            )
            grad_shapes.index_copy_(0, chunk.pairs.flatten(), shape_part.flatten(0, 1))
            grad_features.index_copy_(0, chunk.pairs.flatten(), feature_part.flatten(0, 1))
        # one row for each (tile, splat) pair, summed in a fixed order
        shape = grad.new_zeros(len(opacities), 6).index_add_(0, lists.splats, grad_shapes[:-1])
        feature = grad.new_zeros(len(opacities), CHANNELS).index_add_(0, lists.splats, grad_features[:-1])
        return (
            shape[:, :2].to(means2d.dtype),
            shape[:, 2:5],
            shape[:, 5] / opacities,
            feature,
            None,
            None,
            None,
        )


def _with_padding(
    means2d: Tensor, factors: Tensor, opacities: Tensor, features: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns `[V + 1, 8]` shapes and `[V + 1, 5]` features, the last row a splat of opacity zero."""
    whole = means2d.floor()
    centre = torch.cat([whole, means2d - whole], dim=1).to(factors.dtype)
    shapes = torch.cat([centre, factors, opacities.log()[:, None]], dim=1)
    nothing = shapes.new_tensor([[0, 0, 0, 0, 0, 0, 0, float("-inf")]])
    return torch.cat([shapes, nothing]), torch.cat([features, features.new_zeros(1, CHANNELS)])


def _chunk_gradients(
    chunk: Chunk, shapes: Tensor, features: Tensor, grad: Tensor, limits: Limits, is_capped: bool
) -> tuple[Tensor, Tensor]:
    """Returns the gradients of each (tile, splat) pair's shape `[B, L, 6]` and features `[B, L, 5]`."""
    blended = blend_chunk(chunk, shapes, limits, is_capped)
    alpha, transmittance, u, v = blended.alpha, blended.transmittance, blended.u, blended.v
    slopes = torch.bmm(rows_of(features, chunk.splats), grad).view_as(alpha)  # s
    weights = alpha * transmittance
    grad_features = torch.bmm(grad, weights.flatten(2).transpose(1, 2)).transpose(1, 2)
    # summed from the back: total minus prefix would cancel for splats deep behind others
    from_here = weights.mul_(slopes).flip(1).cumsum_(1).flip(1)
    grad_alpha = transmittance.mul_(slopes)
    grad_alpha[:, :-1].addcdiv_(from_here[:, 1:], blended.through[:, 1:], value=-1)
    # d alpha / d power = alpha, and zero where alpha was dropped or capped
    grad_power = grad_alpha.mul_(alpha)
    if is_capped:
        grad_power.masked_fill_(alpha >= limits.alpha_max, 0)
    size = alpha.shape[-1]
    sum_row, sum_all = _pixel_sums(size, grad.dtype, grad.device)
    by_row = grad_power.flatten(2) @ sum_row  # v and dy are the same along a row
    row_v = by_row * v
    sum_u, sum_u_x, sum_u_y = (grad_power.mul_(u).flatten(2) @ sum_all).unbind(-1)
    sum_u_dx = sum_u_x + sum_u * blended.dx[..., 0]
    sum_u_dy = sum_u_y + sum_u * blended.dy[..., 0]
    sum_v, sum_v_dy = row_v.sum(-1), (row_v * blended.dy).sum(-1)
    l1, m, l2 = rows_of(shapes, chunk.splats)[..., 4:7].unbind(-1)
    parts = [l1 * sum_u, m * sum_u + l2 * sum_v, -sum_u_dx, -sum_u_dy, -sum_v_dy, by_row.sum(-1)]
    return torch.stack(parts, dim=-1), grad_features


def rows_of(table: Tensor, index: Tensor) -> Tensor:
    """Returns `table[index]` for `[R, C]` and `[B, L]`, by the operation that is fastest at it."""
    return table.index_select(0, index.flatten()).view(*index.shape, table.shape[1])


def _pixel_sums(size: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Returns matrices that sum a tile's pixels: by row `[S*S, S]`, and times (1, column, row) `[S*S, 3]`."""
    position = torch.arange(size, dtype=dtype, device=device)
    columns, rows = position.repeat(size), position.repeat_interleave(size)
    return (rows[:, None] == position).to(dtype), torch.stack([torch.ones_like(rows), columns, rows], dim=1)
