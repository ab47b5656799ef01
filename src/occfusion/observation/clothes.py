"""How far clothes stand off the body, as the outlines of masks tell.

Tight ones to a fraction of a pixel, as the mean of many frames, spread over the mesh: at a first look
(`measure_thickness`), and until the dressed body has the outline that masks show (`fit_thickness`). Skirts, coats and
long hair place by place: from each that lies on the outline one goes along the normal, as long as the picture shows the
person there and not another part of the body (`measure_reach`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.camera import project_vertices
from occfusion.geometry.distance import nearest_set, signed_distance
from occfusion.geometry.mesh_spread import spread_over_mesh
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.zbuffer import NO_FACE, rasterize_mesh
from occfusion.human.body import Body
from occfusion.observation.frames import ObservedFrame
from occfusion.observation.keypoints import HEAD, face_vertices
from occfusion.types import Camera, Frame

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

CLOTHES_VIEWS = 60
"""Frames that are to be looked at, at most, evenly spread; at 256 px one takes about 50 ms."""
NEAR = 0.12
"""Metres from the body's outline: what lies farther decides nothing."""
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
FIT_ROUNDS = (40, 20, 10)
"""Rounds of averaging over neighbours by which each correction of the outline is spread: first far, then nearer."""
RIM = 2.0
"""Pixels beyond an outline that are counted to find its length; nearer ones are more where it runs aslant."""
FIT_PRIOR = 0.02
"""Weight of the mean correction, in frames that show a place on the outline."""
FACE = 1.2
"""How far the face reaches from the tip of the nose, in distances from there to an eye: from chin to brow."""
BARE = 0.3
"""Weight with which a face wears nothing, in frames that show a place on the outline, for each frame."""
LEAST_LOOKS = 4
"""Frames that must show a place on the outline."""


def measure_clothes(
    observed_frames: Sequence[ObservedFrame],
    read: Callable[[int], Frame],
    body: Body,
    positions: Sequence[int],
) -> Floats:
    """Returns how far clothes stand off the body at each vertex, tight ones or wide, `[V]`, metres.

    The larger of `fit_thickness` and `measure_reach`.

    Args:
        observed_frames: of all training frames, in order.
        read: gives the training frame at a position.
        body: of the frames.
        positions: of those that are looked at.
    """
    asked = observed_frames, read, body, positions
    return np.maximum(fit_thickness(*asked, bare=face_of(body)), measure_reach(*asked))


def face_of(body: Body) -> Mask:
    """Returns the vertices of the face, chin to brow, bool `[V]`: hair is beside them and above, on the outline."""
    nose, *eyes = face_vertices(body)[:3]
    points = body.v_template.double().cpu().numpy()
    reach = FACE * np.linalg.norm(points[eyes] - points[nose], axis=1).mean()
    on_head = (body.weights[:, HEAD] > 0.5).cpu().numpy()
    is_near: Mask = np.linalg.norm(points - points[nose], axis=1) < reach
    return is_near & on_head


@dataclass(frozen=True)
class Outline:
    """The outline of a posed body in a picture.

    Attributes:
        inside: distance of each pixel to it, inside positive, `[H, W]`, metres.
        vertex: of the body, that the pixel is nearest to, `[H, W]`.
    """

    inside: Floats
    vertex: NDArray[np.int64]

    def depth_inside(self, thickness: Floats) -> Floats:
        """Returns how far each pixel lies within clothes of this thickness `[V]`, `[H, W]`, metres."""
        return self.inside + thickness[self.vertex]


def outline_of(observed_frame: ObservedFrame, camera: Camera, body: Body) -> Outline:
    """Returns the outline of a frame's body."""
    faces, projected = body.faces.cpu().numpy(), observed_frame.projected
    seen = rasterize_mesh(projected.pixels, projected.depths, faces, camera.width, camera.height)
    covered = seen.face >= 0
    metres = float(np.median(projected.depths)) / float(camera.K[0, 0])
    corner = faces[np.maximum(seen.face, 0), seen.barycentrics.argmax(axis=-1)]
    # where the picture shows nothing of the body, all is far from it, and from which vertex makes no difference
    nearest = corner.ravel()[nearest_set(covered)] if covered.any() else np.zeros(covered.shape, np.int64)
    to_edge = signed_distance(covered) + np.where(covered, -0.5, 0.5)  # which runs between two pixels
    return Outline((to_edge * metres).astype(np.float64), nearest.astype(np.int64))


def measure_thickness(
    observed_frames: Sequence[ObservedFrame],
    read: Callable[[int], Frame],
    body: Body,
    positions: Sequence[int],
) -> Floats:
    """Returns how far clothes stand off the body at each vertex, `[V]`, metres.

    For each point of the body's outline in each frame: how many of the known pixels outside and nearest to it show the
    person. Means over the frames, spread over the mesh where little was seen.

    Args:
        observed_frames: of all training frames, in order.
        read: gives the training frame at a position.
        body: of the frames.
        positions: of those that are looked at.
    """
    count = body.num_vertices
    shown, rim = np.zeros(count), np.zeros(count)
    for position in positions:
        observed_frame, frame = observed_frames[position], read(position)
        visible = frame.visible_mask.cpu().numpy()
        outline = outline_of(observed_frame, frame.camera, body)
        metres = float(np.median(observed_frame.projected.depths)) / float(frame.camera.K[0, 0])
        known = visible | observed_frame.evidence.background
        edge = (outline.inside < 0) & (outline.inside > -1.0 * metres)
        # a stretch of outline counts only where what lies before it is known
        near = (outline.inside < 0) & (outline.inside > -0.5 * NEAR)
        unknown = np.bincount(outline.vertex[near & ~known], minlength=count)
        clear = unknown[outline.vertex] == 0
        worn = near & clear & _attached(visible, outline.inside >= 0)
        shown += np.bincount(outline.vertex[worn], minlength=count) * metres
        rim += np.bincount(outline.vertex[edge & clear], minlength=count)
    if rim.sum() == 0:
        return np.zeros_like(shown)
    mean = float(shown.sum() / rim.sum())
    return spread_over_mesh(shown, rim, body.faces.cpu().numpy(), (mean, 0.5))


def fit_thickness(
    observed_frames: Sequence[ObservedFrame],
    read: Callable[[int], Frame],
    body: Body,
    positions: Sequence[int],
    bare: Mask | None = None,
) -> Floats:
    """Returns how far clothes stand off the body at each vertex, so that masks have its outline, `[V]`, metres.

    The body in the clothes found so far is held against the masks again and again: where the person reaches farther,
    they grow, where less far, they shrink. What a first look gets wrong, at hollows and where an outline runs aslant,
    the next one mends.

    Args:
        observed_frames: of all training frames, in order.
        read: gives the training frame at a position.
        body: of the frames.
        positions: of those that are looked at.
        bare: vertices that wear nothing unless outlines say otherwise, bool `[V]`: who faces the camera never shows
            the face from the side, and what is spread from the hair would stand off it; None: none.
    """
    faces = body.faces.cpu().numpy()
    thickness = np.zeros(body.num_vertices)
    belief = np.zeros_like(thickness) if bare is None else BARE * len(positions) * bare
    for rounds in FIT_ROUNDS:
        lacking, rim = np.zeros_like(thickness), np.zeros_like(thickness)
        for position in positions:
            own, length = _misfit(observed_frames[position], read(position), faces, thickness)
            lacking += own
            rim += length
        if rim.sum() == 0:
            return np.zeros_like(thickness)
        mean = float(lacking.sum() / rim.sum())
        lacking, rim = lacking - belief * thickness, rim + belief
        correction = spread_over_mesh(lacking, rim, faces, (mean, FIT_PRIOR), rounds)
        thickness = np.maximum(thickness + correction, 0.0)
    return thickness


def _misfit(
    observed_frame: ObservedFrame, frame: Frame, faces: NDArray[np.int64], thickness: Floats
) -> tuple[Floats, Floats]:
    """Returns what a dressed body's outline lacks of a mask at each vertex, and how long it is there, `[V]` each.

    Metres times pixels, negative where it has too much; pixels. Both are 0 where something may hide the person's end.
    """
    camera, count = frame.camera, len(thickness)
    viewmat, K = camera.viewmat.double().cpu().numpy(), camera.K.double().cpu().numpy()
    dressed = observed_frame.vertices + thickness[:, None] * vertex_normals(observed_frame.vertices, faces)
    pixels, depths = project_vertices(dressed, viewmat, K)
    metres = float(np.median(depths)) / float(K[0, 0])
    seen = rasterize_mesh(pixels, depths, faces, camera.width, camera.height)
    covered = seen.face != NO_FACE
    if not covered.any() or covered.all():  # there is no outline
        return np.zeros(count), np.zeros(count)
    # pixels to the edge, which runs between two of them
    inside = signed_distance(covered) + np.where(covered, -0.5, 0.5)
    corner = faces[np.maximum(seen.face, 0), seen.barycentrics.argmax(axis=-1)]
    # a pixel belongs to the place of the outline that is nearest to it, from within as from outside
    vertex = corner.ravel()[nearest_set(covered & (inside < 1.0))]
    visible = frame.visible_mask.cpu().numpy()
    near = np.abs(inside) * metres < 0.5 * NEAR
    is_hidden = near & ~(visible | observed_frame.evidence.background)
    clear = near & (np.bincount(vertex[is_hidden], minlength=count)[vertex] == 0)
    more, less = clear & ~covered & _attached(visible, covered), clear & covered & ~visible
    pixels_lacking = np.bincount(vertex[more], minlength=count) - np.bincount(vertex[less], minlength=count)
    beyond = clear & ~covered & (inside > -RIM)
    lacking = pixels_lacking.astype(np.float64) * metres
    return lacking, np.bincount(vertex[beyond], minlength=count) / RIM


def _attached(visible: Mask, covered: Mask) -> Mask:
    """Returns the visible pixels that hang together with those on the body."""
    _, labels = cv2.connectedComponents(visible.astype(np.uint8))
    kept = np.unique(labels[visible & covered])
    return visible & np.isin(labels, kept)


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
    column, row = np.floor(at).reshape(len(vertices), -1, 2).transpose(2, 0, 1)
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
