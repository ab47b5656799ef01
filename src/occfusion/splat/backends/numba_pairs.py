"""A Gaussian's gradient on the picture, from those of its (splat, tile) pairs."""

from __future__ import annotations

from typing import Any

from occfusion.cpu.compilation import inline
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
)


@inline
def sum_pairs(pair_slots: Any, first: int, end: int) -> tuple[float, ...]:
    """Returns the ten sums of a splat's gradients over tiles, in the order of the columns, in float64."""
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
    return u, v, ux, uy, vy, power, red, green, blue, depth
