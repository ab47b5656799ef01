"""Spherical harmonics and their derivatives for one direction (see `splat.harmonics`)."""

from __future__ import annotations

from typing import Any

from occfusion.splat.backends.numba_compile import inline
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
    if degree >= 1:
        gx -= SH_C1 * g[3]
        gy -= SH_C1 * g[1]
        gz += SH_C1 * g[2]
    if degree >= 2:
        gx += SH_C2_XY * (y * g[4] - z * g[7]) - 2 * SH_C2_ZZ * x * g[6] + 2 * SH_C2_XX * x * g[8]
        gy += SH_C2_XY * (x * g[4] - z * g[5]) - 2 * SH_C2_ZZ * y * g[6] - 2 * SH_C2_XX * y * g[8]
        gz += 4 * SH_C2_ZZ * z * g[6] - SH_C2_XY * (y * g[5] + x * g[7])
    if degree >= 3:
        xx, yy, zz, xy = x * x, y * y, z * z, x * y
        difference, ring = xx - yy, 4 * zz - xx - yy
        gx += -6 * SH_C3_3 * xy * g[9] + SH_C3_2 * (y * z * g[10] + x * z * g[14]) + 2 * SH_C3_1 * xy * g[11]
        gx += -6 * SH_C3_0 * x * z * g[12] - SH_C3_1 * (ring - 2 * xx) * g[13]
        gx -= 3 * SH_C3_3 * difference * g[15]
        gy += -3 * SH_C3_3 * difference * g[9] + SH_C3_2 * (x * z * g[10] - y * z * g[14])
        gy += -SH_C3_1 * (ring - 2 * yy) * g[11] - 6 * SH_C3_0 * y * z * g[12]
        gy += 2 * SH_C3_1 * xy * g[13] + 6 * SH_C3_3 * xy * g[15]
        gz += SH_C3_2 * (xy * g[10] + 0.5 * difference * g[14]) - 8 * SH_C3_1 * z * (y * g[11] + x * g[13])
        gz += SH_C3_0 * (6 * zz - 3 * xx - 3 * yy) * g[12]
    return gx, gy, gz
