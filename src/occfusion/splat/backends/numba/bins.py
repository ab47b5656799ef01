"""Order of depth, tile lists, and which blocks of a tile a splat reaches.

A set of blocks of a tile has a bit a block. What a splat does not reach is found once, for `GROUP` splats of a list at
a time, in vector code; the loops over lanes then follow the bits that are set. Both passes over a tile use the same
sets.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from occfusion.cpu.compilation import inline, kernel, step
from occfusion.splat.backends.numba.layout import (
    BLOCK,
    BLOCK_BITS,
    BLOCK_COLUMNS,
    BLOCK_ROWS,
    BLOCK_SIZE,
    DEPTH,
    HALF_HEIGHT,
    INVERSE_L1,
    L2,
    LANES,
    REACH,
    SPLAT_SIZE,
    THROUGH,
    TILE_HEIGHT,
    TILE_WIDTH,
    TURN,
    X_PART,
    X_WHOLE,
    Y_PART,
    Y_WHOLE,
    M,
)

SLACK = 1e-3
"""Pixels by which a splat's reach is widened, so that rounding never loses a pixel."""

RADIX_BITS = 11
DIGIT_MASK = np.uint32((1 << RADIX_BITS) - 1)
DIGITS = -(-32 // RADIX_BITS)
SORTED = DIGITS % 2
"""Which of two arrays holds the result once every digit has moved it from one to the other."""


def sort_by_depth(splats: Any, means: Any, camera: Any) -> Any:
    """Returns the visible rows of `splats`, nearest first, equal depths in input order, int32 `[V]`.

    Depths that only single precision makes equal are put in order by their value in double precision, from
    `means` `[N, 3]` and the `camera` of `pack_camera`. They are few: compiled code would take longer to compile
    than it saves.
    """
    index, keys = np.empty((2, len(splats)), np.int32), np.empty((2, len(splats)), np.uint32)
    visible = sort_by_bits(splats.view(np.uint32), index, keys, np.empty(1 << RADIX_BITS, np.int64))
    order = index[SORTED, :visible]
    depths = keys[SORTED, :visible]
    alike = depths[1:] == depths[:-1]
    if not alike.any():
        return order
    is_tied = np.zeros(len(order), bool)
    is_tied[1:] |= alike
    is_tied[:-1] |= alike
    places = np.flatnonzero(is_tied)
    rows = order[places]
    x, y, z = means[rows].astype(np.float64).T
    exact = camera[6] * x + camera[7] * y + camera[8] * z + camera[11]
    order[places] = rows[np.lexsort((exact, depths[places]))]
    return order


@kernel
def sort_by_bits(bits: Any, index: Any, keys: Any, counts: Any) -> int:
    """Returns how many are visible; `index[SORTED]` begins with their rows, nearest first, equal ones in input order.

    A radix sort of the bits of the depth, of which `bits` is the unsigned view: positive floats are ordered like
    their bits, and each pass is stable. The other arguments are working space: `[2, N]` twice and `[2^RADIX_BITS]`.
    """
    visible = 0
    for i in range(bits.shape[0]):
        splat = bits[i]
        # the reach is no less than zero, and positive numbers have positive bits
        if splat[REACH] > 0:
            index[0, visible] = i
            keys[0, visible] = splat[DEPTH]
            visible += 1
    for digits in range(DIGITS):
        shift = np.uint32(RADIX_BITS * digits)
        source, target = index[digits % 2], index[1 - digits % 2]
        known, moved = keys[digits % 2], keys[1 - digits % 2]
        for digit in range(1 << RADIX_BITS):
            counts[digit] = 0
        for i in range(visible):
            counts[(known[i] >> shift) & DIGIT_MASK] += 1
        total = 0
        for digit in range(1 << RADIX_BITS):
            count = counts[digit]
            counts[digit] = total
            total += count
        for i in range(visible):
            digit = (known[i] >> shift) & DIGIT_MASK
            place = counts[digit]
            counts[digit] += 1
            target[place] = source[i]
            moved[place] = known[i]
    return visible


@inline
def strip_span(
    half: Any, turn: Any, reach: Any, m: Any, l2: Any, inverse_l1: Any, top: Any, bottom: Any
) -> tuple[Any, Any]:
    """Returns the x range, relative to the centre, that the seen ellipse has between two values of dy.

    Exact: each end lies at the ellipse's extreme point or, when that is outside the strip, at the
    strip's nearer edge. The range is empty (first > second) when the strip misses the ellipse. The first
    arguments are columns of a splat's row. No branch, so that a loop over splats can be vector code.
    """
    # Python's bounds: numpy's look for NaN, which costs 4 % of a picture here
    low, high = max(top, -half), min(bottom, half)
    right = min(max(turn, low), high)
    left = min(max(-turn, low), high)
    v_right, v_left = l2 * right, l2 * left
    u_right = math.sqrt(max(reach - v_right * v_right, np.float32(0)))
    u_left = math.sqrt(max(reach - v_left * v_left, np.float32(0)))
    start, end = (-u_left - m * left) * inverse_l1, (u_right - m * right) * inverse_l1
    misses = low > high
    return np.float32(1) if misses else start, np.float32(-1) if misses else end


@inline
def first_and_last(low: float, high: float, size: int, most: int) -> tuple[int, int]:
    """Returns the first and last cell of `size` pixels, of 0..most, that hold a pixel centre in [low, high].

    Pixel centres are at whole numbers here. Empty when first > last.
    """
    first = np.maximum(np.ceil(low - SLACK), 0.0)
    last = np.minimum(np.floor(high + SLACK), float(most * size + size - 1))
    if not (first <= last):
        return 1, 0
    return int(first) // size, int(last) // size


def bin_splats(splats: Any, order: Any, x: int, y: int, across: int, down: int) -> Any:
    """Returns the tile lists, and the gradient slots of each Gaussian.

    The lists: for each tile the start of its list, `[tiles + 1]`, and the list entries, row of `splats` and
    gradient slot, `[pairs, 2]`, front to back. The slots of a Gaussian follow one another, from its number in
    `[N + 1]`, so that its gradient is the sum over a run, and the runs are in the order of the Gaussians.
    """
    by_rank = np.zeros(len(order) + 1, np.int32)  # the first pair of each
    pairs = np.empty((max(1024, 4 * len(order)), 2), np.int32)  # tile and rank
    count = list_pairs(splats, order, x, y, across, down, by_rank, pairs)
    if count > len(pairs):
        pairs = np.empty((count, 2), np.int32)
        list_pairs(splats, order, x, y, across, down, by_rank, pairs)
    starts, slots = np.zeros(across * down + 1, np.int32), np.zeros(len(splats) + 1, np.int32)
    entries = np.empty((count, 2), np.int32)
    group_by_tile(pairs, order, by_rank, np.empty(across * down, np.int32), starts, entries, slots)
    return starts, entries, slots


@kernel
def list_pairs(
    splats: Any, order: Any, x: int, y: int, across: int, down: int, by_rank: Any, pairs: Any
) -> int:
    """Writes each splat's tiles to `pairs`, (tile, rank), and where they begin to `by_rank`; returns their number.

    Pairs that do not fit are counted only.
    """
    slot = 0
    for rank in range(order.shape[0]):
        splat = splats[order[rank]]
        centre_x = splat[X_WHOLE] - np.float32(x) + splat[X_PART] - np.float32(0.5)
        centre_y = splat[Y_WHOLE] - np.float32(y) + splat[Y_PART] - np.float32(0.5)
        half = splat[HALF_HEIGHT]
        first_row, last_row = first_and_last(centre_y - half, centre_y + half, TILE_HEIGHT, down - 1)
        for row in range(first_row, last_row + 1):
            top = np.float32(row * TILE_HEIGHT) - centre_y
            left, right = strip_span(
                half, splat[TURN], splat[REACH], splat[M], splat[L2], splat[INVERSE_L1],
                top, top + np.float32(TILE_HEIGHT - 1),
            )  # fmt: skip
            if left > right:
                continue
            first, last = first_and_last(centre_x + left, centre_x + right, TILE_WIDTH, across - 1)
            for column in range(first, last + 1):
                if slot < pairs.shape[0]:
                    pair = pairs[slot]
                    pair[0], pair[1] = row * across + column, rank
                slot += 1
        by_rank[rank + 1] = slot
    return slot


@kernel
def group_by_tile(
    pairs: Any, order: Any, by_rank: Any, places: Any, starts: Any, entries: Any, slots: Any
) -> None:
    """Writes the lists and the slots of `bin_splats`; `starts` and `slots` come as zeros, `places` is working space."""
    count = entries.shape[0]
    for slot in range(count):
        starts[pairs[slot, 0] + 1] += 1
    for tile in range(places.shape[0]):
        starts[tile + 1] += starts[tile]
        places[tile] = starts[tile]
    for rank in range(order.shape[0]):
        slots[order[rank] + 1] = by_rank[rank + 1] - by_rank[rank]
    for i in range(slots.shape[0] - 1):
        slots[i + 1] += slots[i]
    for slot in range(count):
        tile, rank = pairs[slot, 0], pairs[slot, 1]
        entry = entries[places[tile]]
        entry[0], entry[1] = order[rank], slots[order[rank]] + slot - by_rank[rank]
        places[tile] += 1


GROUP = 16
"""Splats of a list that are fetched, and whose blocks are found, together: their memory is waited for at once."""

SHAPE_SIZE = 8

GROUP_ROWS = GROUP + SHAPE_SIZE
"""Rows of the working space of a group: its splats, and `shapes` of `reached_blocks`, which has as many columns."""
HALF = np.float32(0.5)

DE_BRUIJN = 0x077CB531
"""Its five bits from every place on differ: they tell which power of two it was multiplied by."""


def _bit_numbers() -> np.ndarray:
    numbers = np.empty(32, np.int64)
    for bit in range(32):
        numbers[DE_BRUIJN << bit >> 27 & 31] = bit
    return numbers


BIT_NUMBERS = _bit_numbers()


@inline
def lowest_block(blocks: int) -> tuple[int, int]:
    """Returns the number of the lowest block of a set that is not empty, and the set without it."""
    lowest = blocks & -blocks
    return BIT_NUMBERS[(lowest * DE_BRUIJN >> 27) & 31], blocks ^ lowest


@inline
def tile_centre(splat: Any, left: float, top: float) -> tuple[float, float]:
    """Returns the splat's centre relative to the first pixel centre of the tile."""
    return (splat[X_WHOLE] - left) + (splat[X_PART] - HALF), (splat[Y_WHOLE] - top) + (splat[Y_PART] - HALF)


@step
def fetch_group(splats: Any, entries: Any, first: int, count: int, group: Any) -> None:
    """Copies the splats of `count` entries of a list to `group` `[GROUP, SPLAT_SIZE]`."""
    for k in range(count):
        splat = splats[entries[first + k, 0]]
        for i in range(SPLAT_SIZE):
            group[k, i] = splat[i]


@step
def reached_blocks(group: Any, left: float, top: float, shapes: Any, blocks: Any) -> None:
    """Writes the set of blocks that each splat of a group reaches in a tile to `blocks`, int32 `[GROUP]`.

    Blocks touched by the exact ellipse, row of blocks by row of blocks, `SLACK` wider all around. Rows of `group`
    that hold no splat give a set of no meaning. `shapes` `[SHAPE_SIZE, GROUP]` is working space.
    """
    for k in range(GROUP):
        splat = group[k]
        shapes[0, k], shapes[1, k] = tile_centre(splat, left, top)
        shapes[2, k], shapes[3, k], shapes[4, k] = splat[HALF_HEIGHT], splat[TURN], splat[REACH]
        shapes[5, k], shapes[6, k], shapes[7, k] = splat[M], splat[L2], splat[INVERSE_L1]
        blocks[k] = 0
    slack, zero, width = np.float32(SLACK), np.float32(0), np.float32(TILE_WIDTH)
    for row in range(BLOCK_ROWS):
        for k in range(GROUP):
            above = np.float32(row * BLOCK) - shapes[1, k]
            below = above + np.float32(BLOCK - 1)
            start, end = strip_span(
                shapes[2, k], shapes[3, k], shapes[4, k], shapes[5, k], shapes[6, k], shapes[7, k],
                above - slack, below + slack,
            )  # fmt: skip
            # every bound is brought to -1..width before it becomes a whole number: splats can be huge
            first = np.int32(min(max(np.ceil(shapes[0, k] + start - slack), zero), width))
            last = np.int32(
                min(max(np.floor(shapes[0, k] + end + slack), -np.float32(1)), width - np.float32(1))
            )
            before, until = first >> np.int32(BLOCK_BITS), (last + np.int32(BLOCK)) >> np.int32(BLOCK_BITS)
            bits = np.int32((np.int32(1) << until) - (np.int32(1) << before))
            bits = bits if start <= end and first <= last else np.int32(0)
            blocks[k] |= np.int32(bits << np.int32(BLOCK_COLUMNS * row))


@step
def blending_blocks(planes: Any, stop: float, blocks: int) -> int:
    """Returns those of the blocks that have a lane that still blends."""
    blending, left = 0, blocks
    # one set bit after another: a loop over all blocks would become vector code that fetches lane by lane
    while left != 0:
        block, rest = lowest_block(left)
        through = planes[block * BLOCK_SIZE + THROUGH :]
        count = 0
        for i in range(LANES):
            count += through[i] >= stop
        blending |= left ^ rest if count > 0 else 0
        left = rest
    return blending
