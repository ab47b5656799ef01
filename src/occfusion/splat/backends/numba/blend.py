"""Front-to-back blending of tiles (the formulas are those of `torch_blend`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from occfusion.cpu.compilation import inline, kernel, step
from occfusion.splat.backends.numba.bins import (
    GROUP,
    HALF,
    blending_blocks,
    fetch_group,
    lowest_block,
    reached_blocks,
    tile_centre,
)
from occfusion.splat.backends.numba.layout import (
    BLOCK,
    BLOCK_COLUMNS,
    BLOCK_SIZE,
    BLUE,
    COLUMN,
    DEPTH,
    EXP_RANGE,
    EXP_SHIFT,
    GREEN,
    L1,
    L2,
    LANES,
    LATEST,
    LOG_OPACITY,
    P_BLUE,
    P_COVERED,
    P_FAR,
    P_GREEN,
    P_RED,
    RED,
    ROW,
    THROUGH,
    TILE_BLOCKS,
    TILE_HEIGHT,
    TILE_WIDTH,
    M,
)

ALL_BLOCKS = (1 << TILE_BLOCKS) - 1
ZERO = np.float32(0)
ONE = np.float32(1)
LOWEST = np.float32(EXP_SHIFT - EXP_RANGE)

# exp((y - 2.8) / 4) on [-2.8, 2.82]: weighted least squares at Chebyshev nodes, relative error
# 1.1e-8 in exact arithmetic. Raised to the 4th power in float32: at most 6e-7, 1.8e-7 on average.
E0, E1, E2, E3, E4, E5, E6, E7 = (
    np.float32(c)
    for c in (
        0.4965852991250218, 0.12414633379025447, 0.01551831162946343, 0.0012931833311519232,
        8.081046566094183e-05, 4.042894058246815e-06, 1.7130641410262326e-07, 5.946650408206189e-09,
    )
)  # fmt: skip


@inline
def shifted_exp(y: Any) -> Any:
    """Returns exp(y - EXP_SHIFT) for y no less than `LOWEST`; smaller y give the value there."""
    y = y if y > LOWEST else LOWEST
    # in pairs rather than one term after another: a splat's lanes are few, so it is the waiting that costs
    yy = y * y
    low, high = (E0 + y * E1) + yy * (E2 + y * E3), (E4 + y * E5) + yy * (E6 + y * E7)
    p = low + (yy * yy) * high
    p = p * p
    return p * p


@inline
def lane_alpha(
    q: Any, i: int, centre_x: float, centre_y: float, l1: float, m: float, l2: float, log_opacity: float
) -> tuple[Any, Any, Any, Any, Any]:
    """Returns dx, dy, u, v and alpha, neither capped nor cut off, of a splat at a lane of the block `q`."""
    dx, dy = q[COLUMN + i] - centre_x, q[ROW + i] - centre_y
    u = l1 * dx + m * dy
    v = l2 * dy
    return dx, dy, u, v, shifted_exp(log_opacity - HALF * (u * u + v * v))


@kernel
def blend_part(
    splats: Any, starts: Any, entries: Any, tiles: Any, all_planes: Any, all_groups: Any, all_reached: Any,
    grid: Any, limits: Any, background: Any, rgb: Any, alpha: Any, depth: Any, kept: Any, blended: Any,
    part: int, parts: int,
) -> None:  # fmt: skip
    """Blends every `parts`-th of the non-empty `tiles` and writes their pixels.

    Kept for the backward pass, in `kept` `[tiles, 2, TILE_LANES]` the final transmittance, and for each lane
    the number (in the tile's list) of the last splat met before blending stopped; in `blended` `[pairs]` the set
    of blocks that each entry of a list was blended into.
    Working space of each part: `all_planes`, `all_groups` (`backend.working_space`), `all_reached` int32
    `[parts, GROUP]`.
    `grid` is (x, y, tiles in a row) of the crop, `limits` is (alpha_max, alpha_min, stop).
    """
    alpha_max, alpha_min, stop = limits[0], limits[1], limits[2]
    p, group, reached = all_planes[part], all_groups[part], all_reached[part]
    shapes = group[GROUP:]
    height, width = alpha.shape
    for number in range(part, tiles.shape[0], parts):
        tile = tiles[number]
        tile_x, tile_y = tile % grid[2] * TILE_WIDTH, tile // grid[2] * TILE_HEIGHT
        left, top = np.float32(grid[0] + tile_x), np.float32(grid[1] + tile_y)
        clear_planes(p, np.float32(width - tile_x), np.float32(height - tile_y))
        begin, end = starts[tile], starts[tile + 1]
        blending = ALL_BLOCKS
        for first in range(begin, end, GROUP):
            blending = blending_blocks(p, stop, blending)
            if blending == 0:
                for place in range(first, end):
                    blended[place] = 0
                break
            count = np.minimum(GROUP, end - first)
            fetch_group(splats, entries, first, count, group)
            reached_blocks(group, left, top, shapes, reached)
            for k in range(count):
                blocks = np.int64(reached[k]) & blending
                blended[first + k] = blocks
                splat = group[k]
                centre_x, centre_y = tile_centre(splat, left, top)
                l1, m, l2, log_opacity = splat[L1], splat[M], splat[L2], splat[LOG_OPACITY]
                r, g, b, z = splat[RED], splat[GREEN], splat[BLUE], splat[DEPTH]
                rank = np.float32(first + k - begin)
                while blocks != 0:
                    block, blocks = lowest_block(blocks)
                    q = p[block * BLOCK_SIZE :]
                    for i in range(LANES):
                        a = lane_alpha(q, i, centre_x, centre_y, l1, m, l2, log_opacity)[4]
                        a = a if a < alpha_max else alpha_max
                        a = a if a >= alpha_min else ZERO
                        t = q[THROUGH + i]
                        a = a if t >= stop else ZERO
                        q[LATEST + i] = rank if t >= stop else q[LATEST + i]
                        w = a * t
                        q[THROUGH + i] = t * (ONE - a)
                        q[P_RED + i] += w * r
                        q[P_GREEN + i] += w * g
                        q[P_BLUE + i] += w * b
                        q[P_FAR + i] += w * z
                        q[P_COVERED + i] += w
        for block in range(TILE_BLOCKS):
            q = p[block * BLOCK_SIZE :]
            for i in range(LANES):
                kept[number, 0, block * LANES + i] = q[THROUGH + i]
                kept[number, 1, block * LANES + i] = q[LATEST + i]
        write_tile(p, background, tile_x, tile_y, rgb, alpha, depth)


@step
def clear_planes(p: Any, width: float, height: float) -> None:
    """Empties the tile; lanes beyond the crop (`width` x `height` from here) count as fully covered."""
    for block in range(TILE_BLOCKS):
        q = p[block * BLOCK_SIZE :]
        for i in range(P_RED, BLOCK_SIZE):
            q[i] = ZERO
        for i in range(LANES):
            q[THROUGH + i] = ONE if q[COLUMN + i] < width and q[ROW + i] < height else ZERO
            q[LATEST + i] = -ONE


@inline
def place_of(x: int, y: int) -> int:
    """Returns where the lane of a tile's pixel lies in a plane of its block."""
    return (y // BLOCK * BLOCK_COLUMNS + x // BLOCK) * BLOCK_SIZE + y % BLOCK * BLOCK + x % BLOCK


@step
def write_tile(p: Any, background: Any, tile_x: int, tile_y: int, rgb: Any, alpha: Any, depth: Any) -> None:
    """Writes the lanes of a tile to the pixels of the picture that it covers."""
    height, width = alpha.shape
    for y in range(np.minimum(TILE_HEIGHT, height - tile_y)):
        for x in range(np.minimum(TILE_WIDTH, width - tile_x)):
            i = place_of(x, y)
            covered = p[P_COVERED + i]
            alpha[tile_y + y, tile_x + x] = covered
            for channel in range(3):
                color = p[P_RED + channel * LANES + i]
                rgb[tile_y + y, tile_x + x, channel] = color + (ONE - covered) * background[channel]
            depth[tile_y + y, tile_x + x] = p[P_FAR + i] / covered if covered > ZERO else ZERO
