"""The gradient of blending, back to front (the formulas are those of `torch_blend`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from occfusion.splat.backends.numba_blend import (
    BLOCK_COLUMNS,
    HALF,
    ONE,
    ZERO,
    block_span,
    lane_of,
    row_span,
    shifted_exp,
    tile_centre,
)
from occfusion.splat.backends.numba_compile import inline, kernel
from occfusion.splat.backends.numba_layout import (
    BLUE,
    COLUMN,
    DEPTH,
    G_BLUE,
    G_DEPTH,
    G_GREEN,
    G_POWER,
    G_RED,
    G_U,
    G_UX,
    G_UY,
    G_V,
    G_VY,
    GRADIENT_SIZE,
    GREEN,
    HALF_HEIGHT,
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
    PLANES,
    RED,
    ROW,
    ROW_LANES,
    THROUGH,
    TILE_BLOCKS,
    TILE_HEIGHT,
    TILE_LANES,
    TILE_WIDTH,
    M,
)


@kernel
def blend_backward_part(
    packed: Any, starts: Any, entries: Any, tiles: Any, all_planes: Any, grid: Any, limits: Any,
    background: Any, alpha: Any, depth: Any, kept: Any,
    grad_rgb: Any, grad_alpha: Any, grad_depth: Any, slots: Any, part: int, parts: int,
) -> None:  # fmt: skip
    """Writes to `slots` `[pairs, 10]` the gradient of every (splat, tile) pair of its share of the tiles.

    Absent gradients have no rows. A lane's transmittance is recovered from behind by dividing by
    1 - alpha, which is safe because alpha is capped. Blocks whose pixels have no gradient are left out.
    """
    alpha_max, alpha_min = limits[0], limits[1]
    p = all_planes[part]
    block_last = np.empty(TILE_BLOCKS, np.float32)
    for number in range(part, tiles.shape[0], parts):
        tile = tiles[number]
        tile_x, tile_y = tile % grid[2] * TILE_WIDTH, tile // grid[2] * TILE_HEIGHT
        left, top = np.float32(grid[0] + tile_x), np.float32(grid[1] + tile_y)
        for i in range(TILE_LANES):
            p[THROUGH + i] = kept[number, 0, i]
            p[LATEST + i] = kept[number, 1, i]
        load_gradients(grad_rgb, grad_alpha, grad_depth, alpha, depth, background, tile_x, tile_y, p)
        final_place = last_needed(p, block_last)
        begin, end = starts[tile], starts[tile + 1]
        for place in range(end - 1, begin - 1, -1):
            slot = slots[entries[place, 1]]
            for k in range(GRADIENT_SIZE):
                slot[k] = ZERO
            rank = np.float32(place - begin)
            if rank > final_place:
                continue
            splat = packed[entries[place, 0]]
            centre_x, centre_y = tile_centre(splat, left, top)
            first_row, last_row = row_span(centre_y, splat[HALF_HEIGHT])
            l1, m, l2, log_opacity = splat[L1], splat[M], splat[L2], splat[LOG_OPACITY]
            r, g, b, z = splat[RED], splat[GREEN], splat[BLUE], splat[DEPTH]
            u0, v0 = -(l1 * centre_x + m * centre_y), -l2 * centre_y
            sum_u = sum_v = sum_ux = sum_uy = sum_vy = sum_power = ZERO
            sum_r = sum_g = sum_b = sum_z = ZERO
            for row in range(first_row, last_row + 1):
                first, final = block_span(splat, centre_x, centre_y, row)
                base = row * BLOCK_COLUMNS
                while first <= final and block_last[base + first] < rank:
                    first += 1
                while first <= final and block_last[base + final] < rank:
                    final -= 1
                q = p[row * ROW_LANES + first * LANES :]
                for i in range((final - first + 1) * LANES):
                    dx, dy = q[COLUMN + i] - centre_x, q[ROW + i] - centre_y
                    u = u0 + l1 * q[COLUMN + i] + m * q[ROW + i]
                    v = v0 + l2 * q[ROW + i]
                    full = shifted_exp(log_opacity - HALF * (u * u + v * v))
                    a = full if full < alpha_max else alpha_max
                    a = a if a >= alpha_min else ZERO
                    a = a if q[LATEST + i] >= rank else ZERO
                    inverse = ONE / (ONE - a)
                    t = q[THROUGH + i] * inverse
                    q[THROUGH + i] = t
                    w = a * t
                    g_r, g_g, g_b, g_z = q[P_RED + i], q[P_GREEN + i], q[P_BLUE + i], q[P_FAR + i]
                    s = g_r * r + g_g * g + g_b * b + g_z * z + q[P_COVERED + i]
                    power = w * s - a * (q[P_BEHIND + i] * inverse)
                    power = power if full < alpha_max else ZERO
                    q[P_BEHIND + i] += w * s
                    hu, hv = power * u, power * v
                    sum_power += power
                    sum_u += hu
                    sum_v += hv
                    sum_ux += hu * dx
                    sum_uy += hu * dy
                    sum_vy += hv * dy
                    sum_r += w * g_r
                    sum_g += w * g_g
                    sum_b += w * g_b
                    sum_z += w * g_z
            slot[G_U], slot[G_V], slot[G_UX], slot[G_UY] = sum_u, sum_v, sum_ux, sum_uy
            slot[G_VY], slot[G_POWER] = sum_vy, sum_power
            slot[G_RED], slot[G_GREEN], slot[G_BLUE], slot[G_DEPTH] = sum_r, sum_g, sum_b, sum_z


@inline
def load_gradients(
    grad_rgb: Any, grad_alpha: Any, grad_depth: Any, alpha: Any, depth: Any, background: Any,
    tile_x: int, tile_y: int, p: Any,
) -> None:  # fmt: skip
    """Writes the gradients of a tile's blended sums to the planes; zero beyond the crop.

    Depth = far / alpha, so far gets grad_depth / alpha and alpha gets -depth grad_depth / alpha; and
    alpha hides the background.
    """
    height, width = alpha.shape
    for i in range(P_RED, PLANES * TILE_LANES):
        p[i] = ZERO
    for y in range(min(TILE_HEIGHT, height - tile_y)):
        for x in range(min(TILE_WIDTH, width - tile_x)):
            i = lane_of(x, y)
            py, px = tile_y + y, tile_x + x
            covered = ZERO
            if grad_rgb.shape[0] > 0:
                for channel in range(3):
                    grad = grad_rgb[py, px, channel]
                    p[P_RED + channel * TILE_LANES + i] = grad
                    covered -= grad * background[channel]
            if grad_alpha.shape[0] > 0:
                covered += grad_alpha[py, px]
            if grad_depth.shape[0] > 0 and alpha[py, px] > ZERO:
                far = grad_depth[py, px] / alpha[py, px]
                p[P_FAR + i] = far
                covered -= far * depth[py, px]
            p[P_COVERED + i] = covered


@inline
def last_needed(p: Any, block_last: Any) -> Any:
    """Returns the last list place that a lane with a gradient saw; writes it for each block (-1: none)."""
    most = -ONE
    for block in range(TILE_BLOCKS):
        needed = -ONE
        for i in range(block * LANES, (block + 1) * LANES):
            nothing = p[P_RED + i] == ZERO and p[P_GREEN + i] == ZERO and p[P_BLUE + i] == ZERO
            nothing = nothing and p[P_FAR + i] == ZERO and p[P_COVERED + i] == ZERO
            if not nothing and p[LATEST + i] > needed:
                needed = p[LATEST + i]
        block_last[block] = needed
        most = max(most, needed)
    return most
