"""Front-to-back blending of tiles (the formulas are those of `torch_blend`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from occfusion.splat.backends.numba_bins import strip_span
from occfusion.splat.backends.numba_compile import inline, kernel
from occfusion.splat.backends.numba_layout import (
    BLOCK,
    BLUE,
    COLUMN,
    DEPTH,
    EXP_RANGE,
    EXP_SHIFT,
    GREEN,
    HALF_HEIGHT,
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
    PLANES,
    RED,
    ROW,
    ROW_LANES,
    THROUGH,
    TILE_BLOCKS,
    TILE_HEIGHT,
    TILE_LANES,
    TILE_WIDTH,
    X_PART,
    X_WHOLE,
    Y_PART,
    Y_WHOLE,
    M,
)

BLOCK_ROWS = TILE_HEIGHT // BLOCK
BLOCK_COLUMNS = TILE_WIDTH // BLOCK

CHECK_EVERY = 8
"""Splats between two looks at which blocks are fully covered."""

HALF = np.float32(0.5)
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
    p = E0 + y * (E1 + y * (E2 + y * (E3 + y * (E4 + y * (E5 + y * (E6 + y * E7))))))
    p = p * p
    return p * p


@inline
def block_span(splat: Any, centre_x: float, centre_y: float, row: int) -> tuple[int, int]:
    """Returns the first and last block of a row of blocks that the splat reaches; first > last for none."""
    top = np.float32(row * BLOCK) - centre_y
    left, right = strip_span(splat, top, top + np.float32(BLOCK - 1))
    first = max(np.ceil(centre_x + left - np.float32(1e-3)), ZERO)
    last = min(np.floor(centre_x + right + np.float32(1e-3)), np.float32(TILE_WIDTH - 1))
    if not (first <= last) or left > right:
        return 1, 0
    return int(first) // BLOCK, int(last) // BLOCK


@inline
def row_span(centre_y: float, half: float) -> tuple[int, int]:
    """Returns the first and last row of blocks of a tile within `half` of the centre."""
    first = max(np.ceil(centre_y - half - np.float32(1e-3)), ZERO)
    last = min(np.floor(centre_y + half + np.float32(1e-3)), np.float32(TILE_HEIGHT - 1))
    if not (first <= last):
        return 1, 0
    return int(first) // BLOCK, int(last) // BLOCK


@inline
def tile_centre(splat: Any, left: float, top: float) -> tuple[float, float]:
    """Returns the splat's centre relative to the first pixel centre of the tile."""
    return (splat[X_WHOLE] - left) + (splat[X_PART] - HALF), (splat[Y_WHOLE] - top) + (splat[Y_PART] - HALF)


@kernel
def blend_part(
    packed: Any, starts: Any, entries: Any, tiles: Any, all_planes: Any, grid: Any, limits: Any,
    background: Any, rgb: Any, alpha: Any, depth: Any, kept: Any, part: int, parts: int,
) -> None:  # fmt: skip
    """Blends every `parts`-th of the non-empty `tiles` and writes their pixels.

    Kept for the backward pass, `[tiles, 2, TILE_LANES]`: the final transmittance, and for each lane
    the number (in the tile's list) of the last splat met before blending stopped.
    `grid` is (x, y, tiles in a row) of the crop, `limits` is (alpha_max, alpha_min, stop).
    """
    alpha_max, alpha_min, stop = limits[0], limits[1], limits[2]
    p = all_planes[part]
    alive = np.empty(TILE_BLOCKS, np.bool_)
    height, width = alpha.shape
    for number in range(part, tiles.shape[0], parts):
        tile = tiles[number]
        tile_x, tile_y = tile % grid[2] * TILE_WIDTH, tile // grid[2] * TILE_HEIGHT
        left, top = np.float32(grid[0] + tile_x), np.float32(grid[1] + tile_y)
        clear_planes(p, np.float32(width - tile_x), np.float32(height - tile_y))
        count_alive(p, stop, alive)
        begin, end = starts[tile], starts[tile + 1]
        for place in range(begin, end):
            if (place - begin) % CHECK_EVERY == CHECK_EVERY - 1 and count_alive(p, stop, alive) == 0:
                break
            splat = packed[entries[place, 0]]
            centre_x, centre_y = tile_centre(splat, left, top)
            first_row, last_row = row_span(centre_y, splat[HALF_HEIGHT])
            l1, m, l2, log_opacity = splat[L1], splat[M], splat[L2], splat[LOG_OPACITY]
            r, g, b, z = splat[RED], splat[GREEN], splat[BLUE], splat[DEPTH]
            u0, v0 = -(l1 * centre_x + m * centre_y), -l2 * centre_y
            rank = np.float32(place - begin)
            for row in range(first_row, last_row + 1):
                first, final = block_span(splat, centre_x, centre_y, row)
                base = row * BLOCK_COLUMNS
                while first <= final and not alive[base + first]:
                    first += 1
                while first <= final and not alive[base + final]:
                    final -= 1
                q = p[row * ROW_LANES + first * LANES :]
                for i in range((final - first + 1) * LANES):
                    u = u0 + l1 * q[COLUMN + i] + m * q[ROW + i]
                    v = v0 + l2 * q[ROW + i]
                    a = shifted_exp(log_opacity - HALF * (u * u + v * v))
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
        for i in range(TILE_LANES):
            kept[number, 0, i] = p[THROUGH + i]
            kept[number, 1, i] = p[LATEST + i]
        write_tile(p, background, tile_x, tile_y, rgb, alpha, depth)


@inline
def clear_planes(p: Any, width: float, height: float) -> None:
    """Empties the tile; lanes beyond the crop (`width` x `height` from here) count as fully covered."""
    for i in range(P_RED, PLANES * TILE_LANES):
        p[i] = ZERO
    for i in range(TILE_LANES):
        p[THROUGH + i] = ONE if p[COLUMN + i] < width and p[ROW + i] < height else ZERO
        p[LATEST + i] = -ONE


@inline
def count_alive(p: Any, stop: float, alive: Any) -> int:
    """Returns how many blocks still have a lane that blends, and marks them."""
    total = 0
    for block in range(TILE_BLOCKS):
        count = ZERO
        for i in range(THROUGH + block * LANES, THROUGH + (block + 1) * LANES):
            count += ONE if p[i] >= stop else ZERO
        alive[block] = count > ZERO
        total += alive[block]
    return total


@inline
def lane_of(x: int, y: int) -> int:
    """Returns the lane of a tile's pixel."""
    return (y // BLOCK * BLOCK_COLUMNS + x // BLOCK) * LANES + y % BLOCK * BLOCK + x % BLOCK


@inline
def write_tile(p: Any, background: Any, tile_x: int, tile_y: int, rgb: Any, alpha: Any, depth: Any) -> None:
    """Writes the lanes of a tile to the pixels of the picture that it covers."""
    height, width = alpha.shape
    for y in range(min(TILE_HEIGHT, height - tile_y)):
        for x in range(min(TILE_WIDTH, width - tile_x)):
            i = lane_of(x, y)
            covered = p[P_COVERED + i]
            alpha[tile_y + y, tile_x + x] = covered
            for channel in range(3):
                color = p[P_RED + channel * TILE_LANES + i]
                rgb[tile_y + y, tile_x + x, channel] = color + (ONE - covered) * background[channel]
            depth[tile_y + y, tile_x + x] = p[P_FAR + i] / covered if covered > ZERO else ZERO
