"""The gradient of blending, back to front (the formulas are those of `torch_blend`).

There is one kernel for all inputs, and one for colours alone: the weights they are blended with, and nothing else.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from occfusion.cpu.compilation import kernel, step
from occfusion.splat.backends.numba.bins import GROUP, fetch_group, lowest_block, tile_centre
from occfusion.splat.backends.numba.blend import ONE, ZERO, lane_alpha, place_of
from occfusion.splat.backends.numba.layout import (
    BLOCK_SIZE,
    BLUE,
    DEPTH,
    G_BLUE,
    G_DEPTH,
    G_GREEN,
    G_POWER,
    G_RED,
    G_U,
    G_UU,
    G_UV,
    G_V,
    G_VV,
    GRADIENT_SIZE,
    GREEN,
    L1,
    L2,
    LANES,
    LATEST,
    LOG_OPACITY,
    P_BEHIND,
    P_BLUE,
    P_COVERED,
    P_FAR,
    P_GREEN,
    P_RED,
    RED,
    THROUGH,
    TILE_BLOCKS,
    TILE_HEIGHT,
    TILE_WIDTH,
    M,
    local_array,
)

local_sums = local_array((GRADIENT_SIZE * LANES,), np.float32)


@kernel
def blend_backward_part(
    splats: Any, starts: Any, entries: Any, tiles: Any, all_planes: Any, all_groups: Any, all_quarters: Any,
    grid: Any, limits: Any, background: Any, alpha: Any, depth: Any, blended: Any, kept: Any,
    grad_rgb: Any, grad_alpha: Any, grad_depth: Any, slots: Any, part: int, parts: int,
) -> None:  # fmt: skip
    """Writes to `slots` `[pairs, 10]` the gradient of every (splat, tile) pair of its share of the tiles.

    Absent gradients have no rows. A lane's transmittance is recovered from behind, by the odds
    alpha / (1 - alpha), which are safe because alpha is capped. Blocks whose pixels have no gradient are left out.
    """
    alpha_max, alpha_min = limits[0], limits[1]
    p, group, quarters, sums = all_planes[part], all_groups[part], all_quarters[part], local_sums()
    for number in range(part, tiles.shape[0], parts):
        tile = tiles[number]
        tile_x, tile_y = tile % grid[2] * TILE_WIDTH, tile // grid[2] * TILE_HEIGHT
        left, top = np.float32(grid[0] + tile_x), np.float32(grid[1] + tile_y)
        load_kept(kept[number], p)
        load_gradients(grad_rgb, grad_alpha, grad_depth, alpha, depth, background, tile_x, tile_y, p)
        wanted = blocks_with_gradient(p)
        begin, end = starts[tile], starts[tile + 1]
        for until in range(end, begin, -GROUP):
            first = np.maximum(begin, until - GROUP)
            fetch_group(splats, entries, first, until - first, group)
            for place in range(until - 1, first - 1, -1):
                slot = slots[entries[place, 1]]
                blocks = np.int64(blended[place]) & wanted
                if blocks == 0:
                    for j in range(GRADIENT_SIZE):
                        slot[j] = ZERO
                    continue
                splat = group[place - first]
                centre_x, centre_y = tile_centre(splat, left, top)
                l1, m, l2, log_opacity = splat[L1], splat[M], splat[L2], splat[LOG_OPACITY]
                r, g, b, z = splat[RED], splat[GREEN], splat[BLUE], splat[DEPTH]
                rank = np.float32(place - begin)
                for i in range(GRADIENT_SIZE * LANES):
                    sums[i] = ZERO
                while blocks != 0:
                    block, blocks = lowest_block(blocks)
                    q = p[block * BLOCK_SIZE :]
                    for i in range(LANES):
                        _, _, u, v, full = lane_alpha(q, i, centre_x, centre_y, l1, m, l2, log_opacity)
                        a = full if full < alpha_max else alpha_max
                        a = a if a >= alpha_min else ZERO
                        a = a if q[LATEST + i] >= rank else ZERO
                        # transmittance behind the splat; before it that is t / (1 - a) = t + w
                        t, odds = q[THROUGH + i], a / (ONE - a)
                        w = odds * t
                        q[THROUGH + i] = t + w
                        g_r, g_g, g_b, g_z = q[P_RED + i], q[P_GREEN + i], q[P_BLUE + i], q[P_FAR + i]
                        s = g_r * r + g_g * g + g_b * b + g_z * z + q[P_COVERED + i]
                        power = odds * (t * s - q[P_BEHIND + i])
                        power = power if full < alpha_max else ZERO
                        q[P_BEHIND + i] += w * s
                        hu, hv = power * u, power * v
                        # lane by lane: a sum over the lanes of every block would cost more
                        sums[G_U * LANES + i] += hu
                        sums[G_V * LANES + i] += hv
                        sums[G_UU * LANES + i] += hu * u
                        sums[G_UV * LANES + i] += hu * v
                        sums[G_VV * LANES + i] += hv * v
                        sums[G_POWER * LANES + i] += power
                        sums[G_RED * LANES + i] += w * g_r
                        sums[G_GREEN * LANES + i] += w * g_g
                        sums[G_BLUE * LANES + i] += w * g_b
                        sums[G_DEPTH * LANES + i] += w * g_z
                sum_lanes(sums, GRADIENT_SIZE, quarters, slot)


@step
def sum_lanes(sums: Any, count: int, quarters: Any, out: Any) -> None:
    """Writes the sum of the first 16 numbers of `sums` to `out[0]`, of the next 16 to `out[1]`, `count` times.

    Two by two: half the rounding and half the waiting of one by one. `quarters` `[4 count]` is working space: four
    neighbours that go to memory are seen to be a vector.
    """
    for j in range(count):
        for i in range(4):
            k = j * LANES + i
            quarters[4 * j + i] = (sums[k] + sums[k + 8]) + (sums[k + 4] + sums[k + 12])
    for j in range(count):
        k = 4 * j
        out[j] = (quarters[k] + quarters[k + 2]) + (quarters[k + 1] + quarters[k + 3])


@step
def load_kept(kept: Any, p: Any) -> None:
    """Writes what the forward pass kept of a tile, `[2, TILE_LANES]`, to the planes."""
    for block in range(TILE_BLOCKS):
        q = p[block * BLOCK_SIZE :]
        for i in range(LANES):
            q[THROUGH + i] = kept[0, block * LANES + i]
            q[LATEST + i] = kept[1, block * LANES + i]


@step
def load_gradients(
    grad_rgb: Any, grad_alpha: Any, grad_depth: Any, alpha: Any, depth: Any, background: Any,
    tile_x: int, tile_y: int, p: Any,
) -> None:  # fmt: skip
    """Writes the gradients of a tile's blended sums to the planes; zero beyond the crop.

    Depth = far / alpha, so far gets grad_depth / alpha and alpha gets -depth grad_depth / alpha; and
    alpha hides the background.
    """
    height, width = alpha.shape
    for block in range(TILE_BLOCKS):
        q = p[block * BLOCK_SIZE :]
        for i in range(P_RED, BLOCK_SIZE):
            q[i] = ZERO
    for y in range(np.minimum(TILE_HEIGHT, height - tile_y)):
        for x in range(np.minimum(TILE_WIDTH, width - tile_x)):
            i = place_of(x, y)
            py, px = tile_y + y, tile_x + x
            covered = ZERO
            if grad_rgb.shape[0] > 0:
                for channel in range(3):
                    grad = grad_rgb[py, px, channel]
                    p[P_RED + channel * LANES + i] = grad
                    covered -= grad * background[channel]
            if grad_alpha.shape[0] > 0:
                covered += grad_alpha[py, px]
            if grad_depth.shape[0] > 0 and alpha[py, px] > ZERO:
                far = grad_depth[py, px] / alpha[py, px]
                p[P_FAR + i] = far
                covered -= far * depth[py, px]
            p[P_COVERED + i] = covered


@step
def blocks_with_gradient(p: Any) -> int:
    """Returns the blocks with a pixel that has a gradient."""
    blocks = 0
    for block in range(TILE_BLOCKS):
        q = p[block * BLOCK_SIZE :]
        count = 0
        for i in range(P_RED, P_COVERED + LANES):
            count += q[i] != ZERO
        blocks |= (1 if count > 0 else 0) << block
    return blocks


color_sums = local_array((3 * LANES,), np.float32)


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
    p, group, quarters, sums = all_planes[part], all_groups[part], all_quarters[part], color_sums()
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
            first = np.maximum(begin, until - GROUP)
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
