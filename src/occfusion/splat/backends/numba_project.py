"""Projection and colour of each Gaussian, fused (the formulas are those of `splat.projection`)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from occfusion.cpu.compilation import kernel, step
from occfusion.splat.backends.numba_columns import (
    COLUMNS,
    FLAT,
    PART,
    A,
    B,
    C,
    X,
    Y,
    Z,
    face,
    fill,
    flatten,
    load,
    local_rows,
    local_table,
    see,
    spread_basis,
)
from occfusion.splat.backends.numba_layout import (
    BLUE,
    DEPTH,
    EXP_SHIFT,
    GREEN,
    HALF_HEIGHT,
    INVERSE_L1,
    L1,
    L2,
    LOG_OPACITY,
    REACH,
    RED,
    TURN,
    X_PART,
    X_WHOLE,
    Y_PART,
    Y_WHOLE,
    M,
)
from occfusion.splat.backends.numba_local import local_array
from occfusion.splat.limits import COMPENSATION_FLOOR

# Columns that only this pass has.
OPACITY, MX, MY, RX, RY = range(COLUMNS, COLUMNS + 5)
V_LOG, V_REACH, V_L1, V_M, V_L2, V_TURN, V_INVERSE = range(COLUMNS + 5, COLUMNS + 12)

local_columns = local_array((COLUMNS + 12, PART), np.float64)


@kernel
def project_part(
    means: Any, quats: Any, scales: Any, covariances: Any, opacities: Any, colors: Any, offsets: Any,
    camera: Any, window: Any, options: Any, degree: int, splats: Any, radii: Any, part: int, parts: int,
) -> None:  # fmt: skip
    """Writes a row of `splats` `[N, 16]` and of `radii` for each visible Gaussian; REACH is 0 for the others.

    Absent inputs have no rows; `colors` are `[N, 3 K]`. `window` is the range of pixel centres wanted (x0, x1, y0, y1);
    `options` is (near, dilation, alpha_min, antialiased); `degree` is -1 for plain colours.
    """
    n = means.shape[0]
    near, dilation, alpha_min, antialiased = options[0], options[1], options[2], options[3] != 0
    log_alpha_min = math.log(alpha_min)
    bands = (degree + 1) * (degree + 1)
    rows, v, basis = local_rows(), local_columns(), local_table()
    fill(v)
    for begin in range(part * PART, n, parts * PART):
        count = 0
        for i in range(begin, min(n, begin + PART)):
            splats[i, REACH] = 0
            z = camera[6] * means[i, 0] + camera[7] * means[i, 1] + camera[8] * means[i, 2] + camera[11]
            opacity = opacities[i]
            if not (z > near) or not (opacity > alpha_min):
                continue
            rows[count] = i
            load(i, count, means, quats, scales, covariances, v)
            v[OPACITY, count] = opacity
            if offsets.shape[0] > 0:
                v[MX, count], v[MY, count] = offsets[i, 0], offsets[i, 1]
            count += 1
        if count == 0:
            continue
        see(camera, v)
        flatten(covariances.shape[0] > 0, v)
        centre(offsets.shape[0] > 0, camera, v)
        fade(count, dilation, antialiased, v)
        factorize(dilation, log_alpha_min, v)
        if degree >= 0:
            face(camera, v)
            spread_basis(v, basis)
        for k in range(count):
            i = rows[k]
            mx, my, rx, ry = v[MX, k], v[MY, k], v[RX, k], v[RY, k]
            is_faint = antialiased and not (v[OPACITY, k] > alpha_min)
            if (
                is_faint
                or mx + rx < window[0]
                or mx - rx > window[1]
                or my + ry < window[2]
                or my - ry > window[3]
            ):
                continue
            radii[i, 0], radii[i, 1] = rx, ry
            splat = splats[i]
            whole_x, whole_y = np.floor(mx), np.floor(my)
            splat[X_WHOLE], splat[X_PART] = whole_x, mx - whole_x
            splat[Y_WHOLE], splat[Y_PART] = whole_y, my - whole_y
            splat[L1], splat[M], splat[L2] = v[V_L1, k], v[V_M, k], v[V_L2, k]
            splat[LOG_OPACITY] = v[V_LOG, k] + EXP_SHIFT
            splat[DEPTH] = v[Z, k]
            splat[REACH] = v[V_REACH, k]
            splat[HALF_HEIGHT] = ry
            splat[TURN] = v[V_TURN, k]
            splat[INVERSE_L1] = v[V_INVERSE, k]
            if degree < 0:
                splat[RED], splat[GREEN], splat[BLUE] = colors[i, 0], colors[i, 1], colors[i, 2]
                continue
            red = green = blue = np.float32(0.5)
            row = colors[i]
            for j in range(bands):
                red += basis[j, k] * row[3 * j]
                green += basis[j, k] * row[3 * j + 1]
                blue += basis[j, k] * row[3 * j + 2]
            splat[RED] = max(red, np.float32(0))
            splat[GREEN] = max(green, np.float32(0))
            splat[BLUE] = max(blue, np.float32(0))


@step
def centre(has_offsets: bool, camera: Any, v: Any) -> None:
    """Fills the columns of the centre on the picture, pixels; they come with offsets where there are any."""
    for k in range(PART):
        inverse_z = 1 / v[Z, k]
        mx = camera[12] * v[X, k] * inverse_z + camera[14]
        my = camera[13] * v[Y, k] * inverse_z + camera[15]
        v[MX, k] = mx + (v[MX, k] if has_offsets else 0.0)
        v[MY, k] = my + (v[MY, k] if has_offsets else 0.0)


@step
def fade(count: int, dilation: float, antialiased: bool, v: Any) -> None:
    """Compensates the column of opacity for dilation where wanted, and fills that of its logarithm."""
    if antialiased:
        for k in range(PART):
            flat = v[FLAT, k]
            det = flat + dilation * (v[A, k] + v[C, k]) + dilation * dilation
            v[OPACITY, k] *= math.sqrt(max(flat / det, COMPENSATION_FLOOR))
    for k in range(count):
        v[V_LOG, k] = math.log(v[OPACITY, k])


@step
def factorize(dilation: float, log_alpha_min: float, v: Any) -> None:
    """Fills the columns of what is seen of the dilated ellipse and of the factor of its inverse covariance."""
    for k in range(PART):
        b = v[B, k]
        det = v[FLAT, k] + dilation * (v[A, k] + v[C, k]) + dilation * dilation
        a, c = v[A, k] + dilation, v[C, k] + dilation
        reach = 2 * (v[V_LOG, k] - log_alpha_min)
        root_a, root_c, root_det, root_reach = math.sqrt(a), math.sqrt(c), math.sqrt(det), math.sqrt(reach)
        v[RX, k], v[RY, k] = root_reach * root_a, root_reach * root_c
        # one division for both: in float64 they cost most of all here, and rounding is no matter
        inverse = 1 / (root_c * root_det)
        inverse_c, inverse_det = root_det * inverse, root_c * inverse
        v[V_L1, k], v[V_M, k], v[V_L2, k] = root_c * inverse_det, -b * inverse, inverse_c
        v[V_REACH, k] = reach
        v[V_TURN, k] = b * root_reach / root_a
        v[V_INVERSE, k] = root_det * inverse_c
