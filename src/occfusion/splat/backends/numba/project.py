"""Projection and colour of each Gaussian, fused, and the gradients of both and of the camera, in float64.

The formulas are those of `splat.projection`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from occfusion.cpu.compilation import inline, kernel, step
from occfusion.splat.backends.numba.columns import (
    COLUMNS,
    COLUMNS_BACKWARD,
    FLAT,
    G_MX,
    G_MY,
    G_SHAPE,
    G_W,
    G_X,
    G_Y,
    G_Z,
    P_COLOR,
    P_POWER,
    P_U,
    P_V,
    PART,
    V_L1,
    V_L2,
    V_M,
    A,
    B,
    C,
    X,
    Y,
    Z,
    add_to_camera,
    clamp_colors,
    face,
    fill,
    flatten_covariance,
    flatten_root,
    load_centre,
    load_covariance,
    load_root,
    local_rows,
    local_table,
    see,
    spread_basis,
    unface,
    unfactorize,
    unflatten_covariance,
    unflatten_root,
    unsee,
    write_colors,
    write_symmetric,
)
from occfusion.splat.backends.numba.layout import (
    BLUE,
    DEPTH,
    EXP_SHIFT,
    G_BLUE,
    G_DEPTH,
    G_GREEN,
    G_POWER,
    G_RED,
    G_U,
    G_UU,
    G_UV,
    G_V,
    G_VV,
    GRADIENT_SIZE,
    GREEN,
    HALF_HEIGHT,
    INVERSE_L1,
    L1,
    L2,
    LOG_OPACITY,
    REACH,
    RED,
    SPLAT_SIZE,
    TURN,
    X_PART,
    X_WHOLE,
    Y_PART,
    Y_WHOLE,
    M,
    local_array,
)
from occfusion.splat.limits import COMPENSATION_FLOOR


@inline
def sum_pairs(pair_slots: Any, first: int, end: int) -> tuple[float, ...]:
    """Returns the ten sums of a splat's gradients over tiles, in the order of the columns, in float64."""
    u = v = uu = uv = vv = power = red = green = blue = depth = 0.0
    for slot in range(first, end):
        row = pair_slots[slot]
        u += row[G_U]
        v += row[G_V]
        uu += row[G_UU]
        uv += row[G_UV]
        vv += row[G_VV]
        power += row[G_POWER]
        red += row[G_RED]
        green += row[G_GREEN]
        blue += row[G_BLUE]
        depth += row[G_DEPTH]
    return u, v, uu, uv, vv, power, red, green, blue, depth


# Columns that only this pass has.
OPACITY, MX, MY, RX, RY = range(COLUMNS, COLUMNS + 5)
F_LOG, F_REACH, F_L1, F_M, F_L2, F_TURN, F_INVERSE = range(COLUMNS + 5, COLUMNS + 12)

local_columns = local_array((COLUMNS + 12, PART), np.float64)


@kernel
def project_part(
    means: Any, quats: Any, scales: Any, covariances: Any, opacities: Any, colors: Any, offsets: Any,
    camera: Any, window: Any, options: Any, degree: int, splats: Any, radii: Any, part: int, parts: int,
) -> None:  # fmt: skip
    """Writes a row of `splats` `[N, 16]` and of `radii` for each visible Gaussian; REACH is 0 for the others.

    Shapes are `covariances`, or `quats` and `scales`; the others are None, and nothing is compiled for them. Absent
    offsets have no rows; `colors` are `[N, 3 K]`. `window` is the range of pixel centres wanted (x0, x1, y0, y1);
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
        for i in range(begin, np.minimum(n, begin + PART)):
            splats[i, REACH] = 0
            z = camera[6] * means[i, 0] + camera[7] * means[i, 1] + camera[8] * means[i, 2] + camera[11]
            opacity = opacities[i]
            if not (z > near) or not (opacity > alpha_min):
                continue
            rows[count] = i
            load_centre(i, count, means, v)
            # two questions: what asks for an argument that is None is left out, an `else` would not be
            if covariances is not None:
                load_covariance(i, count, covariances, v)
            if quats is not None:
                load_root(i, count, quats, scales, v)
            v[OPACITY, count] = opacity
            if offsets.shape[0] > 0:
                v[MX, count], v[MY, count] = offsets[i, 0], offsets[i, 1]
            count += 1
        if count == 0:
            continue
        see(camera, v)
        if covariances is not None:
            flatten_covariance(v)
        if quats is not None:
            flatten_root(v)
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
            splat[L1], splat[M], splat[L2] = v[F_L1, k], v[F_M, k], v[F_L2, k]
            splat[LOG_OPACITY] = v[F_LOG, k] + EXP_SHIFT
            splat[DEPTH] = v[Z, k]
            splat[REACH] = v[F_REACH, k]
            splat[HALF_HEIGHT] = ry
            splat[TURN] = v[F_TURN, k]
            splat[INVERSE_L1] = v[F_INVERSE, k]
            if degree < 0:
                splat[RED], splat[GREEN], splat[BLUE] = colors[i, 0], colors[i, 1], colors[i, 2]
                continue
            red = green = blue = np.float32(0.5)
            row = colors[i]
            for j in range(bands):
                red += basis[j, k] * row[3 * j]
                green += basis[j, k] * row[3 * j + 1]
                blue += basis[j, k] * row[3 * j + 2]
            splat[RED] = np.maximum(red, np.float32(0))
            splat[GREEN] = np.maximum(green, np.float32(0))
            splat[BLUE] = np.maximum(blue, np.float32(0))


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
            v[OPACITY, k] *= math.sqrt(np.maximum(flat / det, COMPENSATION_FLOOR))
    for k in range(count):
        v[F_LOG, k] = math.log(v[OPACITY, k])


@step
def factorize(dilation: float, log_alpha_min: float, v: Any) -> None:
    """Fills the columns of what is seen of the dilated ellipse and of the factor of its inverse covariance."""
    for k in range(PART):
        b = v[B, k]
        det = v[FLAT, k] + dilation * (v[A, k] + v[C, k]) + dilation * dilation
        a, c = v[A, k] + dilation, v[C, k] + dilation
        reach = 2 * (v[F_LOG, k] - log_alpha_min)
        root_a, root_c, root_det, root_reach = math.sqrt(a), math.sqrt(c), math.sqrt(det), math.sqrt(reach)
        v[RX, k], v[RY, k] = root_reach * root_a, root_reach * root_c
        # one division for both: in float64 they cost most of all here, and rounding is no matter
        inverse = 1 / (root_c * root_det)
        inverse_c, inverse_det = root_det * inverse, root_c * inverse
        v[F_L1, k], v[F_M, k], v[F_L2, k] = root_c * inverse_det, -b * inverse, inverse_c
        v[F_REACH, k] = reach
        v[F_TURN, k] = b * root_reach / root_a
        v[F_INVERSE, k] = root_det * inverse_c


backward_columns = local_array((COLUMNS_BACKWARD, PART), np.float64)


@kernel
def project_backward_part(
    means: Any, quats: Any, scales: Any, covariances: Any, opacities: Any, colors: Any,
    camera: Any, options: Any, degree: int, splats: Any, slots: Any, pair_slots: Any,
    g_means: Any, g_quats: Any, g_scales: Any, g_covariances: Any, g_opacities: Any, g_colors: Any,
    g_offsets: Any, g_camera: Any, wants_camera: bool, part: int, parts: int,
) -> None:  # fmt: skip
    """Writes the gradients of the visible Gaussians; a gradient that nobody asked for has no rows.

    Shapes are as in `project_part`. `colors` and their gradient are `[N, 3 K]`. `slots` `[N + 1]` delimits the rows of
    `pair_slots` of each. `g_camera` `[pieces, 12]`, zeros, gets that of rotation and translation, one row for every
    `PART` Gaussians.
    """
    dilation, antialiased = options[1], options[3] != 0
    wants_place = wants_camera or g_means.shape[0] > 0
    wants_shape = wants_place or g_quats.shape[0] + g_scales.shape[0] + g_covariances.shape[0] > 0
    n = means.shape[0]
    rows, v = local_rows(), backward_columns()
    table, spare = local_table(), local_table()
    bands = (degree + 1) * (degree + 1)
    fill(v)
    for begin in range(part * PART, n, parts * PART):
        count = 0
        for i in range(begin, np.minimum(n, begin + PART)):
            sums = sum_pairs(pair_slots, slots[i], slots[i + 1])
            seen = False
            for j in range(10):
                v[P_U + j, count] = sums[j]
                seen |= sums[j] != 0
            if g_colors.shape[0] > 0 and not seen:  # the largest array comes as it was allocated
                for j in range(g_colors.shape[1]):
                    g_colors[i, j] = 0
            if not seen:
                continue
            rows[count] = i
            splat = splats[i]
            v[V_L1, count], v[V_M, count], v[V_L2, count] = splat[L1], splat[M], splat[L2]
            load_centre(i, count, means, v)
            if covariances is not None:
                load_covariance(i, count, covariances, v)
            if quats is not None:
                load_root(i, count, quats, scales, v)
            count += 1
        if count == 0:
            continue
        if degree >= 0:
            clamp_colors(rows, count, splats, v)
            face(camera, v)
            if g_colors.shape[0] > 0:
                write_colors(rows, count, bands, table, spare, v, g_colors)
        elif g_colors.shape[0] > 0:
            for k in range(count):
                for j in range(3):
                    g_colors[rows[k], j] = v[P_COLOR + j, k]
        if degree > 0 and wants_place:
            unface(rows, count, bands, colors, table, spare, v)
        else:
            for k in range(PART):
                v[G_W, k] = v[G_W + 1, k] = v[G_W + 2, k] = 0
        for k in range(PART):
            v[G_MX, k] = v[V_L1, k] * v[P_U, k]
            v[G_MY, k] = v[V_M, k] * v[P_U, k] + v[V_L2, k] * v[P_V, k]
        if g_offsets.shape[0] > 0:
            for k in range(count):
                i = rows[k]
                g_offsets[i, 0], g_offsets[i, 1] = v[G_MX, k], v[G_MY, k]
        if g_opacities.shape[0] > 0:
            for k in range(count):
                g_opacities[rows[k]] = v[P_POWER, k] / opacities[rows[k]]
        if not wants_shape:
            continue
        see(camera, v)
        if covariances is not None:
            flatten_covariance(v)
        if quats is not None:
            flatten_root(v)
        unfactorize(dilation, antialiased, v)
        if covariances is not None:
            unflatten_covariance(v)
            if g_covariances.shape[0] > 0:
                for k in range(count):
                    write_symmetric(v, k, g_covariances[rows[k]])
        if quats is not None:
            unflatten_root(v)
            if g_quats.shape[0] > 0:
                for k in range(count):
                    for j in range(4):
                        g_quats[rows[k], j] = v[G_SHAPE + j, k]
            if g_scales.shape[0] > 0:
                for k in range(count):
                    for j in range(3):
                        g_scales[rows[k], j] = v[G_SHAPE + 4 + j, k]
        if not wants_place:
            continue
        unsee(camera, v)
        if g_means.shape[0] > 0:
            for k in range(count):
                i, g_x, g_y, g_z = rows[k], v[G_X, k], v[G_Y, k], v[G_Z, k]
                for j in range(3):
                    g_means[i, j] = v[G_W + j, k] + (
                        camera[j] * g_x + camera[3 + j] * g_y + camera[6 + j] * g_z
                    )
        if wants_camera:
            add_to_camera(count, camera, v, g_camera[begin // PART])


def compile_last(of_covariances: bool) -> None:
    """Compiles what a gradient needs last, or loads it from the cache: by the gradients of no Gaussians.

    Torch is not loaded for it, so that a second process begins to compile a second sooner.

    Args:
        of_covariances: for Gaussians whose shapes are covariances; else quaternions and scales.
    """

    def none(*tail: int) -> Any:
        return np.empty((0, *tail), np.float32)

    shapes = (None, None, none(3, 3)) if of_covariances else (none(4), none(3), None)
    project_backward_part(
        none(3), *shapes, none(), none(3), np.zeros(23), np.zeros(4), 0,
        none(SPLAT_SIZE), np.zeros(1, np.int32), none(GRADIENT_SIZE),
        none(3), none(4), none(3), none(3, 3), none(), none(3), none(2), np.zeros((0, 12)), True, 0, 1,
    )  # fmt: skip
