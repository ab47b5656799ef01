"""The arrays that the `numba` kernels share.

A tile is `TILE_WIDTH` x `TILE_HEIGHT` pixels and is stored as blocks of 4 x 4 pixels, 16 lanes
each: a splat touches few blocks in vain, every row of blocks is one run in memory, and a run of
whole blocks is a whole number of vectors.

A splat is one row of 16 numbers, one cache line, in order of depth.
"""

from __future__ import annotations

import numpy as np

BLOCK = 4
LANES = BLOCK * BLOCK
TILE_WIDTH = 32
TILE_HEIGHT = 16
ROW_LANES = TILE_WIDTH * BLOCK
"""Lanes in one row of blocks."""
TILE_LANES = TILE_WIDTH * TILE_HEIGHT
TILE_BLOCKS = TILE_LANES // LANES

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
G_U, G_V, G_UX, G_UY, G_VY, G_POWER, G_RED, G_GREEN, G_BLUE, G_DEPTH = range(10)
GRADIENT_SIZE = 10

# The working values of a tile lie in one array, plane after plane of `TILE_LANES` lanes: planes at
# fixed distances in one array can be seen not to overlap, so loops over lanes become vector code.
COLUMN, ROW, THROUGH, LATEST = 0, TILE_LANES, 2 * TILE_LANES, 3 * TILE_LANES
P_RED, P_GREEN, P_BLUE = 4 * TILE_LANES, 5 * TILE_LANES, 6 * TILE_LANES
P_FAR, P_COVERED, P_BEHIND = 7 * TILE_LANES, 8 * TILE_LANES, 9 * TILE_LANES
PLANES = 10

EXP_SHIFT = 2.8
EXP_RANGE = 5.6
"""exp is needed on [-5.6, 0]: below lies alpha < 1/255 for any opacity. The shift centres that range."""


def new_planes() -> np.ndarray:
    """Returns working planes for one tile, float32 `[PLANES * TILE_LANES]`, columns and rows filled in."""
    lane = np.arange(TILE_LANES)
    block, within = lane // LANES, lane % LANES
    across = TILE_WIDTH // BLOCK
    planes = np.zeros((PLANES, TILE_LANES), np.float32)
    planes[COLUMN // TILE_LANES] = block % across * BLOCK + within % BLOCK
    planes[ROW // TILE_LANES] = block // across * BLOCK + within // BLOCK
    return planes.ravel()
