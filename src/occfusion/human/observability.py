"""What a video says of a body's surface, direction by direction; and views of the surface where it says nothing.

A picture tells where a place lies across the line of sight and nothing of where it lies along it. Seen from one side
alone, a Gaussian may stand anywhere on its line, be as long as it likes along it, and be transparent from behind.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.geometry.camera import orbit_camera, project_vertices
from occfusion.geometry.coverage import SEEN, Coverage, surface_frames
from occfusion.geometry.distance import nearest_set
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.zbuffer import NO_FACE, rasterize_mesh
from occfusion.types import Camera

Floats = NDArray[np.float64]

HALF_ANGLE = 20.0
"""Degrees about a line by which looks spread (root mean square) when the place along it counts as half known."""
KNOWN_LOOKS = 3.0
"""Sum of looks (`geometry.coverage`) at which a place counts as half seen."""
ANGLES = 24
"""Canonical views, evenly round the body."""
DISTANCE = 3.0
"""Metres from the camera of a canonical view to the body: about as far as people are filmed from."""
REACH = 0.25
"""Metres that a canonical view shows around the dressed body."""
AWAY = -0.1
"""Cosine of normal and line of sight below which a place faces away from a canonical view."""
SAMPLES = 2
"""Samples of a canonical view along each side of a pixel: an outline between two pixels is grey."""
UNSURE = 0.010
"""Metres that clothes stand off at which half of it is believed."""


@dataclass(frozen=True)
class Observability:
    """What a video says of each place of a surface in its canonical pose.

    Attributes:
        moments: mean of d d^t over the looks at a place, d the unit direction to the camera, `[V, 3, 3]`.
        passes: the same over all views: an outline is seen of places that face away too.
        axis: the direction of which the video says least, `[V, 3]`: the mean line of sight; of places that no frame
            shows, the normal.
        ignorance: how little it says of it, `[V]`, 0 seen from all round .. 1 from one direction, or not at all.
        unseen: `[V]`, 0 seen often .. 1 never.
        is_seen: bool `[V]`.
    """

    moments: Floats
    passes: Floats
    axis: Floats
    ignorance: Floats
    unseen: Floats
    is_seen: NDArray[np.bool_]

    def turns(self) -> Floats:
        """Returns by how many degrees the directions to the camera spread about their axis at each place, `[V]`.

        Root mean square over all views, whether they show the place or not: 0 from one side, 45 from all round.
        """
        along = np.linalg.eigvalsh(self.passes)[:, 2]
        return np.degrees(np.arcsin(np.sqrt(np.clip(1.0 - along, 0.0, 1.0))))

    def outline_ignorance(self, direction: Floats) -> Floats:
        """Returns how little masks say of where the outline at each place ends along a unit direction `[3]`, `[V]`.

        0: it was seen from across that direction, from whichever side; 1: only along it.
        """
        return _ignorance(1.0 - np.einsum("i,vij,j->v", direction, self.passes, direction))


def observe_surface(
    coverage: Coverage, vertices: NDArray[np.floating], faces: NDArray[np.integer]
) -> Observability:
    """Returns what views say of each place of a surface.

    Args:
        coverage: of the same places.
        vertices: in the canonical pose, `[V, 3]`, metres.
        faces: triangles, `[F, 3]`, corners counter-clockwise from outside.
    """
    points = vertices.astype(np.float64)
    frames = surface_frames(points, faces)
    moments, passes = (
        np.einsum("vki,vkl,vlj->vij", frames, found, frames) for found in (coverage.moments, coverage.passes)
    )
    spreads, axes = np.linalg.eigh(moments)
    is_seen = coverage.looks >= SEEN
    axis = np.where(is_seen[:, None], axes[:, :, 2], vertex_normals(points, faces))
    ignorance = np.where(is_seen, _ignorance(1.0 - spreads[:, 2]), 1.0)
    return Observability(
        moments, passes, axis, ignorance, 1.0 / (1.0 + (coverage.looks / KNOWN_LOOKS) ** 2), is_seen
    )


def _ignorance(across: Floats) -> Floats:
    """Returns how little looks say of a direction, from the mean squared sine of their angles to it."""
    half = math.sin(math.radians(HALF_ANGLE)) ** 2
    return np.asarray(1.0 / (1.0 + (np.maximum(across, 0.0) / half) ** 2))


@dataclass(frozen=True)
class ObservedSurface:
    """A body's surface as a video shows it.

    Attributes:
        known: what it says of each place.
        ignorance: mean of that of all places by their area, 0..1.
        turn: mean of `Observability.turns` likewise, degrees.
        thickness: how far clothes stand off at each place, `[V]`, metres; 0 where nothing is closed and nobody looked.
        pixel: metres that a pixel of the video covers at the person.
    """

    known: Observability
    ignorance: float
    turn: float
    thickness: Floats
    pixel: float

    @property
    def heights(self) -> Floats:
        """How far off the body its dressed surface is taken to be, see `dressed_heights`, `[V]`, metres."""
        return dressed_heights(self.thickness, self.known)


def dressed_heights(thickness: Floats, known: Observability) -> Floats:
    """Returns how far off a body its dressed surface is taken to be where a video leaves that open, `[V]`, metres.

    Outlines tell how far skirts and hair stand off, and only at the sides. What is spread from there is wrong by a few
    millimetres everywhere, so that little counts for less than it says, and much for nearly all of it.

    Args:
        thickness: how far clothes stand off at each place, `[V]`, metres.
        known: what the video says of the same places.
    """
    worn = np.maximum(thickness, 0.0)
    return known.ignorance * worn**2 / (worn + UNSURE)


@dataclass(frozen=True)
class CanonicalView:
    """The dressed body in its canonical pose from one side, and how little the video says of it.

    Shares and weights are bytes, 255 for 1: of pictures that are drawn now and then there are many.

    Attributes:
        camera: of the picture.
        alpha: share of each pixel that the dressed body covers, `[H, W]`.
        weight: how little the video itself says of the outline from here, at the nearest place, `[H, W]`.
        unseen: how far the place of the body that a pixel shows was never seen, `[H, W]`; 0 outside.
        is_away: vertices that face away from the camera, float32, 0 or 1, `[V]`.
    """

    camera: Camera
    alpha: Tensor
    weight: Tensor
    unseen: Tensor
    is_away: Tensor

    def to(self, device: torch.device) -> CanonicalView:
        """Returns the view with its tensors on `device`."""
        return CanonicalView(*(getattr(self, part.name).to(device) for part in fields(self)))


def canonical_views(
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    known: Observability,
    thickness: Floats,
    pixel: float,
) -> list[CanonicalView]:
    """Returns the dressed body from `ANGLES` sides.

    Args:
        vertices: of the body in the canonical pose, `[V, 3]`, metres.
        faces: triangles, `[F, 3]`.
        known: of the same places.
        thickness: how far clothes stand off at each place, `[V]`, metres.
        pixel: metres that a pixel is to cover.
    """
    points = vertices.astype(np.float64)
    normals = vertex_normals(points, faces)
    dressed = points + np.maximum(thickness, 0.0)[:, None] * normals
    middle = 0.5 * (dressed.min(axis=0) + dressed.max(axis=0))
    radius = float(np.linalg.norm(dressed - middle, axis=1).max()) + REACH
    field_of_view = 2.0 * math.atan(radius / DISTANCE)
    size = math.ceil(2.0 * radius / pixel)
    return [
        _canonical_view(dressed, faces, normals, known, camera)
        for camera in (
            orbit_camera(torch.from_numpy(middle), 2.0 * math.pi * k / ANGLES, DISTANCE, field_of_view, size)
            for k in range(ANGLES)
        )
    ]


def _canonical_view(
    dressed: Floats, faces: NDArray[np.integer], normals: Floats, known: Observability, camera: Camera
) -> CanonicalView:
    viewmat, K = camera.viewmat.numpy().astype(np.float64), camera.K.numpy().astype(np.float64)
    pixels, depths = project_vertices(dressed, viewmat, K)
    seen = rasterize_mesh(pixels * SAMPLES, depths, faces, camera.width * SAMPLES, camera.height * SAMPLES)
    samples = (seen.face != NO_FACE).reshape(camera.height, SAMPLES, camera.width, SAMPLES)
    alpha = samples.mean(axis=(1, 3))
    # one sample of each pixel is enough for what changes slowly; where it misses the body, the nearest that does not
    middle = slice(SAMPLES // 2, None, SAMPLES)
    face, shares = seen.face[middle, middle], seen.barycentrics[middle, middle]
    covered = face != NO_FACE
    corner = faces[np.maximum(face, 0), shares.argmax(axis=2)]
    vertex = corner.ravel()[nearest_set(covered)]
    towards = camera.centre.numpy() - dressed
    cosine = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    return CanonicalView(
        Camera(camera.viewmat.float(), camera.K.float(), camera.width, camera.height),
        _as_bytes(alpha),
        _as_bytes(known.outline_ignorance(viewmat[0, :3])[vertex]),
        _as_bytes(np.where(covered, known.unseen[vertex], 0.0)),
        torch.from_numpy((cosine < AWAY).astype(np.float32)),
    )


def _as_bytes(values: Floats) -> Tensor:
    """Returns values in 0..1 as bytes, 255 for 1."""
    return torch.from_numpy((values.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))
