"""The arrays that the `numba` kernels share.

A tile is `TILE_WIDTH` x `TILE_HEIGHT` pixels and is stored as blocks of 4 x 4 pixels, 16 lanes
each: a splat touches few blocks in vain, and a block is a whole number of vectors.

A splat is one row of 16 numbers, one cache line.


Small arrays that live in a kernel's own frame are made by `local_array`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import from_dtype, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

BLOCK_BITS = 2
BLOCK = 1 << BLOCK_BITS
LANES = BLOCK * BLOCK
TILE_WIDTH = 32
TILE_HEIGHT = 16
BLOCK_COLUMNS = TILE_WIDTH // BLOCK
BLOCK_ROWS = TILE_HEIGHT // BLOCK
TILE_BLOCKS = BLOCK_ROWS * BLOCK_COLUMNS
"""As many as an unsigned 32-bit number has bits: a set of blocks is one."""
TILE_LANES = TILE_BLOCKS * LANES

# Columns of a splat's row. The centre is a whole number of pixels plus a fraction: a float32 at
# 2000 px would be 1e-4 px off.
X_WHOLE, X_PART, Y_WHOLE, Y_PART = 0, 1, 2, 3
L1, M, L2 = 4, 5, 6
LOG_OPACITY = 7  # plus EXP_SHIFT
RED, GREEN, BLUE, DEPTH = 8, 9, 10, 11
REACH = 12  # largest u^2 + v^2 that is seen
HALF_HEIGHT = 13  # of the seen ellipse
TURN = 14  # dy of its rightmost point; the leftmost is opposite
INVERSE_L1 = 15
SPLAT_SIZE = 16

# Columns of the gradient that blending leaves for each (splat, tile) pair.
G_U, G_V, G_UU, G_UV, G_VV, G_POWER, G_RED, G_GREEN, G_BLUE, G_DEPTH = range(10)
GRADIENT_SIZE = 10

# The working values of a tile lie in one array, block after block, and those of a block plane after plane of
# `LANES` lanes: planes at fixed distances in one array can be seen not to overlap, so a loop over the lanes
# becomes vector code, and a block is ten neighbouring cache lines.
COLUMN, ROW, THROUGH, LATEST = 0, LANES, 2 * LANES, 3 * LANES
P_RED, P_GREEN, P_BLUE = 4 * LANES, 5 * LANES, 6 * LANES
P_FAR, P_COVERED, P_BEHIND = 7 * LANES, 8 * LANES, 9 * LANES
BLOCK_SIZE = 10 * LANES

EXP_SHIFT = 2.8
EXP_RANGE = 5.6
"""exp is needed on [-5.6, 0]: below lies alpha < 1/255 for any opacity. The shift centres that range."""


def new_planes() -> np.ndarray:
    """Returns working planes for one tile, float32 `[TILE_BLOCKS * BLOCK_SIZE]`, columns and rows filled in."""
    block, lane = np.arange(TILE_BLOCKS)[:, None], np.arange(LANES)
    planes = np.zeros((TILE_BLOCKS, BLOCK_SIZE), np.float32)
    planes[:, COLUMN : COLUMN + LANES] = block % BLOCK_COLUMNS * BLOCK + lane % BLOCK
    planes[:, ROW : ROW + LANES] = block // BLOCK_COLUMNS * BLOCK + lane // BLOCK
    return planes.ravel()


def local_array(shape: tuple[int, ...], dtype: Any) -> Any:
    """Returns a helper for kernels that returns an uninitialised array of this shape and type, of a few kB at most.

    Nothing else can point to it, which the compiler sees: loops over it become vector code without a check for
    overlaps, and what is summed there lane by lane stays in registers.
    """
    dtype = np.dtype(dtype)
    kind = types.Array(from_dtype(dtype), len(shape), "C")
    strides = [math.prod(shape[axis + 1 :]) * dtype.itemsize for axis in range(len(shape))]

    @intrinsic
    def array(_: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            def sizes(values: Any) -> Any:
                return [context.get_constant(types.intp, value) for value in values]

            memory = cgutils.alloca_once(builder, context.get_data_type(kind.dtype), size=math.prod(shape))
            made = make_array(kind)(context, builder)
            populate_array(
                made, memory, sizes(shape), sizes(strides), sizes([dtype.itemsize])[0], meminfo=None
            )
            return made._getvalue()

        return kind(), generate

    return array
