"""The gradient of blending when colours alone need one: the weights they are blended with, and nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np

from occfusion.cpu.compilation import kernel
from occfusion.splat.backends.numba_blend import ONE, ZERO, lane_alpha
from occfusion.splat.backends.numba_blend_backward import (
    blocks_with_gradient,
    load_gradients,
    load_kept,
    sum_lanes,
)
from occfusion.splat.backends.numba_blocks import GROUP, fetch_group, lowest_block, tile_centre
from occfusion.splat.backends.numba_layout import (
    BLOCK_SIZE,
    G_RED,
    GRADIENT_SIZE,
    L1,
    L2,
    LANES,
    LATEST,
    LOG_OPACITY,
    P_BLUE,
    P_GREEN,
    P_RED,
    THROUGH,
    TILE_HEIGHT,
    TILE_WIDTH,
    M,
)
from occfusion.splat.backends.numba_local import local_array

local_sums = local_array((3 * LANES,), np.float32)


@kernel
def blend_colors_backward_part(
    splats: Any, starts: Any, entries: Any, tiles: Any, all_planes: Any, all_groups: Any, all_quarters: Any,
    grid: Any, limits: Any, background: Any, alpha: Any, depth: Any, blended: Any, kept: Any, grad_rgb: Any, slots: Any,
    part: int, parts: int,
) -> None:  # fmt: skip
    """Writes to `slots` `[pairs, 10]` the colour gradient of every (splat, tile) pair, zero for all else.

    The arguments are those of `blend_backward_part`, and so is every rounding: a colour's gradient does not
    depend on what else was asked for.
    """
    alpha_max, alpha_min = limits[0], limits[1]
    p, group, quarters, sums = all_planes[part], all_groups[part], all_quarters[part], local_sums()
    absent = np.empty((0, 1), np.float32)
    for number in range(part, tiles.shape[0], parts):
        tile = tiles[number]
        tile_x, tile_y = tile % grid[2] * TILE_WIDTH, tile // grid[2] * TILE_HEIGHT
        left, top = np.float32(grid[0] + tile_x), np.float32(grid[1] + tile_y)
        load_kept(kept[number], p)
        load_gradients(grad_rgb, absent, absent, alpha, depth, background, tile_x, tile_y, p)
        wanted = blocks_with_gradient(p)
        begin, end = starts[tile], starts[tile + 1]
        for until in range(end, begin, -GROUP):
            first = max(begin, until - GROUP)
            fetch_group(splats, entries, first, until - first, group)
            for place in range(until - 1, first - 1, -1):
                slot = slots[entries[place, 1]]
                for j in range(GRADIENT_SIZE):
                    slot[j] = ZERO
                blocks = np.int64(blended[place]) & wanted
                if blocks == 0:
                    continue
                splat = group[place - first]
                centre_x, centre_y = tile_centre(splat, left, top)
                l1, m, l2, log_opacity = splat[L1], splat[M], splat[L2], splat[LOG_OPACITY]
                rank = np.float32(place - begin)
                for i in range(3 * LANES):
                    sums[i] = ZERO
                while blocks != 0:
                    block, blocks = lowest_block(blocks)
                    q = p[block * BLOCK_SIZE :]
                    for i in range(LANES):
                        a = lane_alpha(q, i, centre_x, centre_y, l1, m, l2, log_opacity)[4]
                        a = a if a < alpha_max else alpha_max
                        a = a if a >= alpha_min else ZERO
                        a = a if q[LATEST + i] >= rank else ZERO
                        t, odds = q[THROUGH + i], a / (ONE - a)
                        w = odds * t
                        q[THROUGH + i] = t + w
                        sums[i] += w * q[P_RED + i]
                        sums[LANES + i] += w * q[P_GREEN + i]
                        sums[2 * LANES + i] += w * q[P_BLUE + i]
                sum_lanes(sums, 3, quarters, slot[G_RED:])
