"""Sets of blocks of a tile, a bit a block: which ones a splat reaches, which ones still matter.

What a splat does not reach is found once, for `GROUP` splats of a list at a time, in vector code; the loops over
lanes then follow the bits that are set. Both passes over a tile use the same sets.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from occfusion.cpu.compilation import inline, step
from occfusion.splat.backends.numba_bins import SLACK, strip_span
from occfusion.splat.backends.numba_layout import (
    BLOCK,
    BLOCK_BITS,
    BLOCK_COLUMNS,
    BLOCK_ROWS,
    BLOCK_SIZE,
    HALF_HEIGHT,
    INVERSE_L1,
    L2,
    LANES,
    REACH,
    SPLAT_SIZE,
    THROUGH,
    TILE_WIDTH,
    TURN,
    X_PART,
    X_WHOLE,
    Y_PART,
    Y_WHOLE,
    M,
)

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
