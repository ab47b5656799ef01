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

from dataclasses import dataclass

import torch
from torch import Tensor

from occfusion.splat.limits import Limits
from occfusion.splat.once import differentiable_once
from occfusion.splat.tiles import TileLists, picture_to_tiles, tiles_to_picture
from occfusion.types import Box

CHUNK = 150_000
"""Elements (tile x splat x pixel) blended at once: the working arrays of a chunk stay in the cache.
Measured at 75 k, 150 k and 400 k elements: 78, 77 and 127 ms for forward and backward."""

CHANNELS = 5
"""Features a splat carries through the blend: three of colour, its depth, and 1 for alpha."""


@dataclass(frozen=True)
class Chunk:
    """Some tiles of similar list length, padded to the longest.

    Attributes:
        rows: the tiles' rows in the tile lists (and in the stacked output).
        pairs: the (tile, splat) pairs' rows among those of all chunks, padding included.
        splats: `[B, L]` positions of splats; padding points at a splat of opacity zero.
        x: middle of each tile, `[B, 1]`, full-picture pixels.
        y: the same of the rows, `[B, 1]`.
    """

    rows: slice
    pairs: slice
    splats: Tensor
    x: Tensor
    y: Tensor


def chunks(lists: TileLists, crop: Box, padding: int, dtype: torch.dtype) -> list[Chunk]:
    """Returns the tiles of the lists in chunks of about `CHUNK` elements; `padding` is the empty splat."""
    size, device = lists.size, lists.splats.device
    counts = lists.counts.tolist()
    padded = torch.cat([lists.splats, lists.splats.new_full((1,), padding)])
    left = (lists.tiles % lists.across) * size + crop[0]
    top = torch.div(lists.tiles, lists.across, rounding_mode="floor") * size + crop[1]
    x, y = (left.to(dtype) + 0.5 * size)[:, None], (top.to(dtype) + 0.5 * size)[:, None]
    found: list[Chunk] = []
    begin = pairs = 0
    while begin < len(counts):
        longest = counts[begin]  # lists are sorted by length
        end = min(len(counts), begin + max(1, CHUNK // (longest * size * size)))
        rows = slice(begin, end)
        rank = torch.arange(longest, device=device)
        position = lists.starts[rows, None] + rank
        position = torch.where(rank < lists.counts[rows, None], position, len(lists.splats))
        last = pairs + (end - begin) * longest
        found.append(Chunk(rows, slice(pairs, last), padded[position], x[rows], y[rows]))
        begin, pairs = end, last
    return found


@dataclass(frozen=True)
class Blended:
    """Intermediate values of a chunk; `[B, L, S, S]` unless said otherwise.

    Attributes:
        shapes: the splats' rows of `_with_padding`, `[B, L, 8]`.
        dx: middle of the tile minus splat centre, columns, `[B, L]`.
        dy: the same for rows.
        u: first whitened coordinate.
        v: second whitened coordinate, the same for a whole row, `[B, L, S]`.
        alpha: as blended: capped, zero when dropped.
        through: what the splats before let through one by one: 1, then 1 - alpha of the one before.
        transmittance: in front of each splat; zero once blending has stopped.
    """

    shapes: Tensor
    dx: Tensor
    dy: Tensor
    u: Tensor
    v: Tensor
    alpha: Tensor
    through: Tensor
    transmittance: Tensor


def blend_chunk(chunk: Chunk, shapes: Tensor, plane: Plane, limits: Limits, is_capped: bool) -> Blended:
    """Returns alphas and transmittances.

    `is_capped`: whether any opacity reaches `alpha_max`.
    `shapes` `[V + 1, 8]` is the centre's whole pixels x, y, the rest of it, l1, m, l2, log opacity. The difference
    of two whole pixels is exact, so the distance is as exact at the far corner as at the first.
    """
    picked = rows_of(shapes, chunk.splats)
    whole_x, whole_y, part_x, part_y, l1, m, l2, log_opacity = picked.unbind(2)
    dx, dy = (chunk.x - whole_x) - part_x, (chunk.y - whole_y) - part_y
    v = l2[..., None] * (dy[..., None] + plane.steps)
    # linear over the tile: a matrix product is many times faster than broadcasting over its short rows
    u = torch.stack([l1 * dx + m * dy, l1, m], dim=-1).flatten(0, 1) @ plane.basis
    u = u.view(*v.shape, -1)
    row_term = torch.addcmul(log_opacity[..., None], v, v, value=-0.5)
    alpha = torch.addcmul(row_term[..., None], u, u, value=-0.5).exp_()
    torch.threshold_(alpha, limits.alpha_min, 0.0)
    if is_capped:
        alpha.clamp_(max=limits.alpha_max)
    through = torch.empty_like(alpha)
    through[:, 0] = 1
    torch.sub(1, alpha[:, :-1], out=through[:, 1:])
    transmittance = torch.threshold_(through.cumprod(dim=1), limits.stop, 0.0)
    return Blended(picked, dx, dy, u, v, alpha, through, transmittance)


@dataclass(frozen=True)
class Plane:
    """What is the same for every tile: places of its pixels around its middle.

    Attributes:
        steps: places of the columns, and of the rows, `[S]`, pixels.
        basis: `[3, S * S]`: 1, column, row of each pixel.
        by_row: `[S * S, max(S, 16)]`, sums over rows; columns beyond S are zero, since a product with fewer than
            16 takes more than twice as long.
    """

    steps: Tensor
    basis: Tensor
    by_row: Tensor


def plane_of(size: int, like: Tensor) -> Plane:
    """Returns the plane of a tile's size, in the dtype and on the device of `like`."""
    steps = torch.arange(size, dtype=like.dtype, device=like.device) - 0.5 * (size - 1)
    basis = torch.stack(
        [torch.ones_like(steps).repeat(size), steps.repeat(size), steps.repeat_interleave(size)]
    )
    by_row = like.new_zeros(size * size, max(size, 16))
    by_row[:, :size] = torch.eye(size, dtype=like.dtype, device=like.device).repeat_interleave(size, dim=0)
    return Plane(steps, basis, by_row)


class Blend(torch.autograd.Function):
    """Blends tile lists into a picture; the gradient is analytic and recomputes each chunk."""

    @staticmethod
    def forward(ctx, means2d, factors, opacities, features, lists, crop, limits):  # type: ignore[no-untyped-def]
        """Returns rgb `[h, w, 3]`, alpha and weighted depth `[h, w]`; `features` are `[V, 5]`."""
        shapes, padded = _with_padding(means2d, factors, opacities, features)
        is_capped = bool((opacities >= limits.alpha_max).any())
        stacked = features.new_empty(len(lists.tiles), CHANNELS, lists.size**2)
        parts, plane = chunks(lists, crop, len(opacities), opacities.dtype), plane_of(lists.size, opacities)
        for chunk in parts:
            blended = blend_chunk(chunk, shapes, plane, limits, is_capped)
            weights = blended.transmittance.mul_(blended.alpha).flatten(2)
            torch.bmm(rows_of(padded, chunk.splats).transpose(1, 2), weights, out=stacked[chunk.rows])
        ctx.save_for_backward(means2d, factors, opacities, features)
        ctx.plan = lists, parts, plane, crop, limits, is_capped
        ctx.set_materialize_grads(False)
        return tiles_to_picture(stacked, lists, crop)

    @staticmethod
    @differentiable_once
    def backward(ctx, grad_rgb, grad_alpha, grad_depth):  # type: ignore[no-untyped-def]
        """Returns the gradients of means2d, factors, opacities and features."""
        means2d, factors, opacities, features = ctx.saved_tensors
        lists, parts, plane, crop, limits, is_capped = ctx.plan
        grad = picture_to_tiles(grad_rgb, grad_alpha, grad_depth, lists, crop, opacities)
        shapes, padded = _with_padding(means2d, factors, opacities, features)
        pairs = grad.new_empty(parts[-1].pairs.stop if parts else 0, 6 + CHANNELS)
        for chunk in parts:
            pairs[chunk.pairs] = _chunk_gradients(
                chunk, shapes, padded, plane, grad[chunk.rows], limits, is_capped
            )
        # one row for each (tile, splat) pair, summed in a fixed order
        splats = torch.cat([lists.splats.new_empty(0), *(chunk.splats.flatten() for chunk in parts)])
        total = grad.new_zeros(len(opacities) + 1, 6 + CHANNELS).index_add_(0, splats, pairs)[:-1]
        to_shapes = total[:, :2].to(means2d.dtype), total[:, 2:5], total[:, 5] / opacities
        return (*to_shapes, total[:, 6:], None, None, None)


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
    chunk: Chunk,
    shapes: Tensor,
    features: Tensor,
    plane: Plane,
    grad: Tensor,
    limits: Limits,
    is_capped: bool,
) -> Tensor:
    """Returns the gradients of each (tile, splat) pair's shape and features, `[B * L, 6 + 5]`."""
    blended = blend_chunk(chunk, shapes, plane, limits, is_capped)
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
    by_row = (grad_power.flatten(2) @ plane.by_row)[..., :size]  # v and dy are the same along a row
    row_v = by_row * v
    # `linear` is three times as fast as the same product written with `@`
    sum_u, sum_u_x, sum_u_y = torch.nn.functional.linear(grad_power.mul_(u).flatten(2), plane.basis).unbind(
        -1
    )
    sum_v, sum_v_y = row_v.sum(-1), row_v @ plane.steps
    l1, m, l2 = blended.shapes[..., 4:7].unbind(-1)
    parts = [
        l1 * sum_u,
        m * sum_u + l2 * sum_v,
        -(sum_u_x + sum_u * blended.dx),
        -(sum_u_y + sum_u * blended.dy),
        -(sum_v_y + sum_v * blended.dy),
        by_row.sum(-1),
    ]
    return torch.cat([torch.stack(parts, dim=-1), grad_features], dim=-1).flatten(0, 1)


def rows_of(table: Tensor, index: Tensor) -> Tensor:
    """Returns `table[index]` for `[R, C]` and `[B, L]`, by the operation that is fastest at it."""
    return table.index_select(0, index.flatten()).view(*index.shape, table.shape[1])
