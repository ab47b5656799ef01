"""A Gaussian's gradient on the picture, from those of its (splat, tile) pairs."""

from __future__ import annotations

from typing import Any

from occfusion.splat.backends.numba_compile import inline
from occfusion.splat.backends.numba_layout import (
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
)


@inline
def sum_pairs(pair_slots: Any, first: int, end: int, out: Any) -> bool:
    """Writes the sum of a splat's gradients over tiles to `out`; returns whether any is not zero."""
    u = v = ux = uy = vy = power = red = green = blue = depth = 0.0
    for slot in range(first, end):
        row = pair_slots[slot]
        u += row[G_U]
        v += row[G_V]
        ux += row[G_UX]
        uy += row[G_UY]
        vy += row[G_VY]
        power += row[G_POWER]
        red += row[G_RED]
        green += row[G_GREEN]
        blue += row[G_BLUE]
        depth += row[G_DEPTH]
    out[G_U], out[G_V], out[G_UX], out[G_UY], out[G_VY], out[G_POWER] = u, v, ux, uy, vy, power
    out[G_RED], out[G_GREEN], out[G_BLUE], out[G_DEPTH] = red, green, blue, depth
    seen = False
    for k in range(GRADIENT_SIZE):
        seen |= out[k] != 0
    return seen
