"""Real spherical harmonics up to degree 3, the view-dependent colour of 3DGS."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

MAX_DEGREE = 3

# Normalisation of the real harmonics Y_lm (without Condon-Shortley phase).
SH_C0 = 0.5 * math.sqrt(1 / math.pi)
SH_C1 = 0.5 * math.sqrt(3 / math.pi)
SH_C2_XY = 0.5 * math.sqrt(15 / math.pi)
SH_C2_ZZ = 0.25 * math.sqrt(5 / math.pi)
SH_C2_XX = 0.25 * math.sqrt(15 / math.pi)
SH_C3_3 = 0.25 * math.sqrt(35 / (2 * math.pi))
SH_C3_2 = 0.5 * math.sqrt(105 / math.pi)
SH_C3_1 = 0.25 * math.sqrt(21 / (2 * math.pi))
SH_C3_0 = 0.25 * math.sqrt(7 / math.pi)

COLOR_OFFSET = 0.5
"""3DGS stores colours around mid grey: all coefficients zero is grey."""


def num_coefficients(degree: int) -> int:
    """Returns how many coefficients per channel a degree has."""
    return (degree + 1) ** 2


def basis(directions: Tensor, degree: int) -> Tensor:
    """Returns the basis functions at unit directions `[..., 3]`, `[..., (degree + 1)**2]`.

    Order and signs are those of 3DGS: m runs from -l to l and odd m carry a minus sign.
    """
    import torch  # where it is used: kernels are compiled with the constants alone

    x, y, z = directions.unbind(-1)
    bands = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        bands += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        bands += [
            SH_C2_XY * x * y,
            -SH_C2_XY * y * z,
            SH_C2_ZZ * (2 * zz - xx - yy),
            -SH_C2_XY * x * z,
            SH_C2_XX * (xx - yy),
        ]
    if degree >= 3:
        bands += [
            -SH_C3_3 * y * (3 * xx - yy),
            SH_C3_2 * x * y * z,
            -SH_C3_1 * y * (4 * zz - xx - yy),
            SH_C3_0 * z * (2 * zz - 3 * xx - 3 * yy),
            -SH_C3_1 * x * (4 * zz - xx - yy),
            0.5 * SH_C3_2 * z * (xx - yy),
            -SH_C3_3 * x * (xx - 3 * yy),
        ]
    return torch.stack(bands, dim=-1)


def evaluate(sh: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Returns colours `[N, 3]` of coefficients `sh` `[N, K, 3]` seen along unit directions `[N, 3]`.

    Only the bands up to `degree` are read. The colour is 0.5 plus the sum, clamped at 0 from below
    (without gradient there).
    """
    import torch

    active = num_coefficients(degree)
    weights = basis(directions, degree)
    return torch.einsum("nk,nkc->nc", weights, sh[:, :active]).add(COLOR_OFFSET).clamp_min(0)
