"""Spherical harmonics and their derivatives for one direction (see `splat.harmonics`)."""

from __future__ import annotations

from typing import Any

from occfusion.cpu.compilation import inline
from occfusion.splat.harmonics import (
    SH_C0,
    SH_C1,
    SH_C2_XX,
    SH_C2_XY,
    SH_C2_ZZ,
    SH_C3_0,
    SH_C3_1,
    SH_C3_2,
    SH_C3_3,
)

BASIS_SIZE = 16
"""Functions of the highest degree and all below it."""


@inline
def fill_basis(x: float, y: float, z: float, degree: int, out: Any) -> None:
    """Writes the `(degree + 1)**2` basis functions at the unit direction (x, y, z) to `out`."""
    out[0] = SH_C0
    if degree >= 1:
        out[1] = -SH_C1 * y
        out[2] = SH_C1 * z
        out[3] = -SH_C1 * x
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        out[4] = SH_C2_XY * x * y
        out[5] = -SH_C2_XY * y * z
        out[6] = SH_C2_ZZ * (2 * zz - xx - yy)
        out[7] = -SH_C2_XY * x * z
        out[8] = SH_C2_XX * (xx - yy)
        if degree >= 3:
            out[9] = -SH_C3_3 * y * (3 * xx - yy)
            out[10] = SH_C3_2 * x * y * z
            out[11] = -SH_C3_1 * y * (4 * zz - xx - yy)
            out[12] = SH_C3_0 * z * (2 * zz - 3 * xx - 3 * yy)
            out[13] = -SH_C3_1 * x * (4 * zz - xx - yy)
            out[14] = 0.5 * SH_C3_2 * z * (xx - yy)
            out[15] = -SH_C3_3 * x * (xx - 3 * yy)


@inline
def direction_gradient(x: float, y: float, z: float, degree: int, g: Any) -> tuple[float, float, float]:
    """Returns the gradient with respect to (x, y, z), given `g[k]`, that of basis function k."""
    gx = gy = gz = 0.0
    # each is fetched once: a fetch costs more time to compile than what is done with it
    if degree >= 1:
        gx -= SH_C1 * g[3]
        gy -= SH_C1 * g[1]
        gz += SH_C1 * g[2]
    if degree >= 2:
        g4, g5, g6, g7, g8 = g[4], g[5], g[6], g[7], g[8]
        gx += SH_C2_XY * (y * g4 - z * g7) - 2 * SH_C2_ZZ * x * g6 + 2 * SH_C2_XX * x * g8
        gy += SH_C2_XY * (x * g4 - z * g5) - 2 * SH_C2_ZZ * y * g6 - 2 * SH_C2_XX * y * g8
        gz += 4 * SH_C2_ZZ * z * g6 - SH_C2_XY * (y * g5 + x * g7)
    if degree >= 3:
        g9, g10, g11, g12, g13, g14, g15 = g[9], g[10], g[11], g[12], g[13], g[14], g[15]
        xx, yy, zz, xy = x * x, y * y, z * z, x * y
        difference, ring = xx - yy, 4 * zz - xx - yy
        gx += -6 * SH_C3_3 * xy * g9 + SH_C3_2 * (y * z * g10 + x * z * g14) + 2 * SH_C3_1 * xy * g11
        gx += -6 * SH_C3_0 * x * z * g12 - SH_C3_1 * (ring - 2 * xx) * g13
        gx -= 3 * SH_C3_3 * difference * g15
        gy += -3 * SH_C3_3 * difference * g9 + SH_C3_2 * (x * z * g10 - y * z * g14)
        gy += -SH_C3_1 * (ring - 2 * yy) * g11 - 6 * SH_C3_0 * y * z * g12
        gy += 2 * SH_C3_1 * xy * g13 + 6 * SH_C3_3 * xy * g15
        gz += SH_C3_2 * (xy * g10 + 0.5 * difference * g14) - 8 * SH_C3_1 * z * (y * g11 + x * g13)
        gz += SH_C3_0 * (6 * zz - 3 * xx - 3 * yy) * g12
    return gx, gy, gz
