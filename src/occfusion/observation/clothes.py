"""How far clothes reach beyond the outline of the body: skirts, coats, long hair.

From each place of the body that lies on its outline in a picture one goes outwards along the normal, as long as the
picture shows the person there and not another part of the body.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.camera import project_vertices
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.zbuffer import NO_FACE, rasterize_mesh
from occfusion.human.body import Body
from occfusion.observation.frames import ObservedFrame
from occfusion.types import Camera, Frame

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

FARTHEST = 0.3
"""Metres from the body within which its clothes are looked for."""
LEAVES = 0.03
"""Metres along a normal within which it must leave the body's outline: farther, it crosses another part of the body."""
BETWEEN = 0.6
"""Share of what lies between two parts of the body, as between legs, that each gets: half of it and a little."""
MARGIN = 1.5
"""Pixels that do not count: of tight clothes, which `measure_thickness` tells better, nothing is left."""
FINEST = 0.004
"""Metres, the least between two places along a normal; else it is half a pixel."""
LEAST_LOOKS = 4
"""Frames that must show a place on the outline."""
ROUNDS = 40
"""How often what is measured of clothes is averaged over neighbours on the mesh."""


def reach_in_picture(
    vertices: Floats,
    faces: NDArray[np.integer],
    camera: Camera,
    visible: Mask,
    background: Mask,
    step: float,
) -> Floats:
    """Returns how far the person is seen beyond the outline of a posed body at each vertex, `[V]`, metres.

    NaN where a vertex does not lie on the outline, and where something may hide the end.

    Args:
        vertices: in the world, `[V, 3]`, metres.
        faces: `[F, 3]`, corners counter-clockwise from outside.
        camera: of the picture.
        visible: pixels that show the person, `[H, W]`.
        background: pixels that show no person for certain, `[H, W]`.
        step: metres between two places along a normal.
    """
    viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    pixels, depths = project_vertices(vertices, viewmat, K)
    body = rasterize_mesh(pixels, depths, faces, camera.width, camera.height).face != NO_FACE
    heights = np.arange(0.0, FARTHEST, step)
    places = vertices[:, None] + heights[:, None] * vertex_normals(vertices, faces)[:, None]
    at, depth = project_vertices(places.reshape(-1, 3), viewmat, K)
    column, row = np.floor(np.nan_to_num(at, posinf=-1.0)).reshape(len(vertices), -1, 2).transpose(2, 0, 1)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    inside &= depth.reshape(inside.shape) > 0.0
    where = row.clip(0, camera.height - 1).astype(np.int64), column.clip(0, camera.width - 1).astype(np.int64)
    is_off = ~body[where]
    start = is_off.argmax(axis=1)
    is_end = (np.arange(len(heights)) >= start[:, None]) & ~(is_off & visible[where])
    end = is_end.argmax(axis=1)
    there = np.arange(len(vertices)), end
    is_known = np.where(is_off, background[where], True)[there]
    is_known &= is_off.any(axis=1) & is_end.any(axis=1) & inside.all(axis=1) & (heights[start] <= LEAVES)
    share = np.where(is_off[there], 1.0, BETWEEN)
    return np.where(is_known, share * (heights[end] - heights[start]), np.nan)


def measure_reach(
    observed_frames: Sequence[ObservedFrame],
    read: Callable[[int], Frame],
    body: Body,
    positions: Sequence[int],
) -> Floats:
    """Returns how far clothes reach beyond the outline of the body at each vertex, `[V]`, metres.

    The median over the frames that tell, less `MARGIN`; where none does, what neighbours on the mesh have.

    Args:
        observed_frames: of all training frames, in order.
        read: gives the training frame at a position.
        body: of the frames.
        positions: of those that are looked at.
    """
    faces, found, pixels = body.faces.cpu().numpy(), [], []
    for position in positions:
        observed_frame, frame = observed_frames[position], read(position)
        pixel = float(np.median(observed_frame.projected.depths)) / float(frame.camera.K[0, 0])
        visible, background = frame.visible_mask.cpu().numpy(), observed_frame.evidence.background
        camera, step = frame.camera.to("cpu"), max(0.5 * pixel, FINEST)
        found.append(reach_in_picture(observed_frame.vertices, faces, camera, visible, background, step))
        pixels.append(pixel)
    each = np.stack(found)
    is_told = np.isfinite(each).sum(axis=0) >= LEAST_LOOKS
    reach = np.zeros(each.shape[1])
    if not is_told.any():
        return reach
    reach[is_told] = np.maximum(
        np.nanmedian(each[:, is_told], axis=0) - MARGIN * float(np.median(pixels)), 0.0
    )
    return np.where(is_told, reach, spread_over_mesh(reach, is_told.astype(np.float64), faces))


def spread_over_mesh(
    total: Floats, weight: Floats, faces: NDArray[np.int64], prior: tuple[float, float] = (0.0, 1e-9)
) -> Floats:
    """Returns `total / weight`, averaged over neighbours on the mesh again and again; weight carries belief, `[V]`.

    Args:
        total: sum of what was measured at each vertex, `[V]`.
        weight: how much was, `[V]`.
        faces: `[F, 3]`.
        prior: a value, and the weight that it has everywhere.
    """
    a, b = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    degree = np.maximum(np.bincount(a, minlength=len(total)), 1)
    for _ in range(ROUNDS):
        total = 0.5 * total + 0.5 * np.bincount(a, total[b], minlength=len(total)) / degree
        weight = 0.5 * weight + 0.5 * np.bincount(a, weight[b], minlength=len(weight)) / degree
    return (total + prior[0] * prior[1]) / (weight + prior[1])
