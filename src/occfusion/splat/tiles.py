"""Which splats touch which tile, front to back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from occfusion.splat.projection import Splats
from occfusion.types import Box

SLACK = 1e-4
"""Relative slack of the tile test: rounding may add a pair that turns out to be nothing, but never
lose one."""


@dataclass(frozen=True)
class TileLists:
    """For each non-empty tile the splats that touch it.

    Attributes:
        tiles: numbers of the non-empty tiles (row by row over the crop), `[B]`, longest list first.
        starts: where each one's list begins in `splats`, `[B]`.
        counts: length of each list, `[B]`.
        splats: positions of splats, grouped by tile, front to back within a tile, `[M]`.
        across: tiles in a row of the crop.
        down: tiles in a column of the crop.
        size: edge of a tile in pixels.
    """

    tiles: Tensor
    starts: Tensor
    counts: Tensor
    splats: Tensor
    across: int
    down: int
    size: int


@torch.no_grad()
def bin_splats(splats: Splats, crop: Box, size: int, alpha_min: float) -> TileLists:
    """Returns the tile lists of a crop.

    Splats are taken in order of depth, equal depths in order of the input, so that every list is
    front to back and the picture does not depend on how a sort breaks ties.
    """
    x, y, width, height = crop
    across, down = -(-width // size), -(-height // size)
    order = torch.sort(splats.exact_depths, stable=True).indices
    centre, extent = splats.means2d[order], splats.extents[order].double()
    corner = centre.new_tensor([x + 0.5, y + 0.5])
    last_pixel = torch.tensor([width - 1, height - 1], device=centre.device)
    # clamping before the cast keeps huge splats inside the range of integers
    largest = max(width, height)
    first = (centre - extent - corner).clamp(-1, largest).ceil().long().clamp_min(0) // size
    last = torch.minimum((centre + extent - corner).clamp(-1, largest).floor().long(), last_pixel) // size
    spans = (last - first + 1).clamp_min(0)
    pairs = spans[:, 0] * spans[:, 1]
    rank = torch.repeat_interleave(torch.arange(len(order), device=order.device), pairs)
    within = torch.arange(len(rank), device=rank.device) - (pairs.cumsum(0) - pairs).index_select(0, rank)
    across_span = spans[:, 0].index_select(0, rank)
    tile_x = first[:, 0].index_select(0, rank) + within % across_span
    tile_y = first[:, 1].index_select(0, rank) + within // across_span
    splat = order.index_select(0, rank)
    keep = _reaches_tile(splats, splat, x + tile_x * size, y + tile_y * size, size, alpha_min)
    tile, splat = (tile_y * across + tile_x)[keep], splat[keep]
    tile, by_tile = torch.sort(tile, stable=True)
    tiles, counts = torch.unique_consecutive(tile, return_counts=True)
    starts = counts.cumsum(0) - counts
    longest = torch.sort(counts, descending=True, stable=True).indices
    return TileLists(tiles[longest], starts[longest], counts[longest], splat[by_tile], across, down, size)


def _pixel_index(lists: TileLists, crop: Box) -> Tensor:
    """Returns where each pixel of each tile lies in the flattened crop, `[B * S * S]`.

    Pixels of the last tiles that stick out of the crop get the number after the last pixel.
    """
    _, _, width, height = crop
    step = torch.arange(lists.size, device=lists.tiles.device)
    columns = (lists.tiles % lists.across * lists.size)[:, None, None] + step
    rows = (lists.tiles // lists.across * lists.size)[:, None, None] + step[:, None]
    inside = (columns < width) & (rows < height)
    return torch.where(inside, rows * width + columns, width * height).flatten()


def tiles_to_picture(stacked: Tensor, lists: TileLists, crop: Box) -> tuple[Tensor, Tensor, Tensor]:
    """Returns rgb `[h, w, 3]`, alpha and weighted depth `[h, w]` of stacked tiles `[B, 5, S * S]`.

    Pixels of tiles without splats are zero.
    """
    _, _, width, height = crop
    index = _pixel_index(lists, crop)
    rgb = stacked.new_zeros(height * width + 1, 3)
    rgb.index_copy_(0, index, stacked[:, :3].transpose(1, 2).reshape(-1, 3))
    depth, alpha = (
        stacked.new_zeros(height * width + 1).index_copy_(0, index, stacked[:, channel].flatten())
        for channel in (3, 4)
    )
    shape = (height, width)
    return rgb[:-1].view(*shape, 3), alpha[:-1].view(shape), depth[:-1].view(shape)


def picture_to_tiles(
    rgb: Tensor | None, alpha: Tensor | None, depth: Tensor | None, lists: TileLists, crop: Box, like: Tensor
) -> Tensor:
    """Returns the inverse arrangement, `[B, 5, S * S]` in the dtype of `like`; None layers are zero."""
    pixels = crop[2] * crop[3]
    index = _pixel_index(lists, crop)
    inside = index < pixels
    index = index.clamp_max(pixels - 1)
    stacked = like.new_zeros(len(lists.tiles), 5, lists.size**2)
    if rgb is not None:
        picked = rgb.reshape(pixels, 3).index_select(0, index) * inside[:, None]
        stacked[:, :3] = picked.view(len(lists.tiles), lists.size**2, 3).transpose(1, 2)
    for channel, layer in ((3, depth), (4, alpha)):
        if layer is not None:
            stacked[:, channel] = (layer.reshape(-1).index_select(0, index) * inside).view(
                len(lists.tiles), lists.size**2
            )
    return stacked


def _reaches_tile(
    splats: Splats, splat: Tensor, left: Tensor, top: Tensor, size: int, alpha_min: float
) -> Tensor:
    """Returns whether alpha can reach alpha_min at a pixel centre of the tile, bool `[M]`.

    The smallest u^2 + v^2 over the tile's rectangle of pixel centres lies on the edges that face the
    splat's centre (at the centre itself when it is inside), each a parabola clamped to the edge.
    """
    mx, my = splats.means2d.to(splats.factors.dtype).index_select(0, splat).unbind(-1)
    l1, m, l2 = splats.factors.index_select(0, splat).unbind(-1)
    x0, y0 = left + 0.5 - mx, top + 0.5 - my
    x1, y1 = x0 + (size - 1), y0 + (size - 1)
    zero = torch.zeros_like(mx)
    near_x, near_y = zero.clamp(x0, x1), zero.clamp(y0, y1)

    def form(dx: Tensor, dy: Tensor) -> Tensor:
        return (l1 * dx + m * dy).square() + (l2 * dy).square()

    on_column = form(near_x, (-l1 * m * near_x / (m * m + l2 * l2)).clamp(y0, y1))
    on_row = form((-m * near_y / l1).clamp(x0, x1), near_y)
    reach = 2 * (splats.opacities.log() - math.log(alpha_min)).index_select(0, splat)
    return torch.minimum(on_column, on_row) <= reach * (1 + SLACK) + SLACK
