"""From gradients on the picture to gradients of the Gaussians and the camera, in float64."""

from __future__ import annotations

from typing import Any

import numpy as np

from occfusion.cpu.compilation import kernel
from occfusion.splat.backends.numba_columns import (
    PART,
    face,
    fill,
    flatten,
    load,
    local_rows,
    local_table,
    see,
)
from occfusion.splat.backends.numba_columns_backward import (
    COLUMNS_BACKWARD,
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
    V_L1,
    V_L2,
    V_M,
    add_to_camera,
    clamp_colors,
    unface,
    unfactorize,
    unflatten,
    unsee,
    write_colors,
    write_symmetric,
)
from occfusion.splat.backends.numba_layout import L1, L2, M
from occfusion.splat.backends.numba_local import local_array
from occfusion.splat.backends.numba_pairs import sum_pairs

local_columns = local_array((COLUMNS_BACKWARD, PART), np.float64)


@kernel
def project_backward_part(
    means: Any, quats: Any, scales: Any, covariances: Any, opacities: Any, colors: Any,
    camera: Any, options: Any, degree: int, splats: Any, slots: Any, pair_slots: Any,
    g_means: Any, g_quats: Any, g_scales: Any, g_covariances: Any, g_opacities: Any, g_colors: Any,
    g_offsets: Any, g_camera: Any, wants_camera: bool, part: int, parts: int,
) -> None:  # fmt: skip
    """Writes the gradients of the visible Gaussians; a gradient that nobody asked for has no rows.

    `colors` and their gradient are `[N, 3 K]`. `slots` `[N + 1]` delimits the rows of `pair_slots` of each.
    `g_camera` `[pieces, 12]`, zeros, gets that of rotation and translation, one row for every `PART` Gaussians.
    """
    dilation, antialiased = options[1], options[3] != 0
    wants_place = wants_camera or g_means.shape[0] > 0
    wants_shape = wants_place or g_quats.shape[0] + g_scales.shape[0] + g_covariances.shape[0] > 0
    n = means.shape[0]
    rows, v = local_rows(), local_columns()
    table, spare = local_table(), local_table()
    bands = (degree + 1) * (degree + 1)
    fill(v)
    for begin in range(part * PART, n, parts * PART):
        count = 0
        for i in range(begin, min(n, begin + PART)):
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
            load(i, count, means, quats, scales, covariances, v)
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
        flatten(covariances.shape[0] > 0, v)
        unfactorize(dilation, antialiased, v)
        unflatten(covariances.shape[0] > 0, v)
        if g_covariances.shape[0] > 0:
            for k in range(count):
                write_symmetric(v, k, g_covariances[rows[k]])
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
