"""How often, and from how many directions, each place of a body's surface is seen.

A place is a vertex. A view sees it where it projects onto a pixel that shows the person, nothing of the body lies in
front, and the surface faces the camera. One look counts as much as the cosine of the angle between the surface's
normal and the direction to the camera: grazing looks count little. Directions are compared in a frame that is fixed to
the surface, so that a limb that turns is seen from several directions as if the camera had gone round it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.cpu.compilation import kernel
from occfusion.geometry.camera import project_vertices
from occfusion.geometry.distance import nearest_set
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.zbuffer import NEAR, NO_FACE, ZBuffer, nearest_faces

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

UNSEEN, ONE, MANY = 0, 1, 2
"""Classes of places: not seen, seen from one direction, seen from many."""

CLASSES = {"seen_many": MANY, "seen_one": ONE, "unseen": UNSEEN}
"""Names of the classes in `plan.json`, `metrics.json` and tables."""

GRAZING = 0.2
"""Cosine below which a look shows nothing of a place: 78 degrees from the normal."""
SEEN = 0.5
"""Sum of looks from which a place counts as seen: one at 60 degrees or two at 75."""
CONE = 30.0
"""Degrees about their mean within which looks are one direction."""
MOST = 0.95
"""Share of the looks that has to lie within the cone; the rest may be a moment's error of pose."""
SLACK = 0.01
"""Metres that a place may lie behind the surface at its pixel; besides half a pixel's diagonal along the slope."""


@dataclass(frozen=True)
class Sighting:
    """One view of a body.

    Attributes:
        vertices: posed, in the world, `[V, 3]`, metres.
        pixels: where they appear, `[V, 2]`, pixels (centres at +0.5).
        depths: along the optical axis, `[V]`, metres.
        centre: of the camera, `[3]`, metres.
        focal: length in pixels.
        visible: pixels that show the person, bool `[H, W]`.
    """

    vertices: Floats
    pixels: Floats
    depths: Floats
    centre: Floats
    focal: float
    visible: NDArray[np.bool_]

    @classmethod
    def through(cls, vertices: Floats, viewmat: Floats, K: Floats, visible: NDArray[np.bool_]) -> Sighting:
        """Returns the view of a pinhole camera, world to camera `[4, 4]` and intrinsics `[3, 3]`."""
        pixels, depths = project_vertices(vertices, viewmat, K)
        centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
        return cls(vertices, pixels, depths, centre, float(K[0, 0]), visible)


@dataclass(frozen=True)
class Coverage:
    """How well places are seen.

    Attributes:
        views: how many views were looked at.
        looks: sum of the looks at each place, `[V]`.
        spread: degrees about their mean direction within which `MOST` of the looks at a place lie, `[V]`; NaN where
            it was not seen.
        moments: weighted mean of d d^t over the looks, d the unit direction to the camera in the frame of the place
            (`surface_frames`), `[V, 3, 3]`; of trace 1, zero where it was not seen.
        passes: the same over all views alike, whether they show the place or not: from where its outline was seen.
    """

    views: int
    looks: Floats
    spread: Floats
    moments: Floats
    passes: Floats

    @property
    def classes(self) -> NDArray[np.int8]:
        """Each place's class, `[V]`: `UNSEEN`, `ONE` or `MANY`."""
        seen = self.looks >= SEEN
        return np.where(seen, np.where(np.nan_to_num(self.spread) > CONE, MANY, ONE), UNSEEN).astype(np.int8)


def cover(
    sightings: Iterable[Sighting], faces: NDArray[np.integer], *, closed: bool = False
) -> Coverage | None:
    """Returns how well each place is seen; None without any view.

    Args:
        sightings: views of the same body.
        faces: triangles, `[F, 3]`, corners counter-clockwise from outside.
        closed: as in `nearest_faces`.
    """
    weights: list[NDArray[np.float32]] = []
    directions: list[NDArray[np.float32]] = []
    for sighting in sightings:
        if not weights:
            count = len(sighting.vertices)
            partners, moments, passes = (
                _partners(count, faces),
                np.zeros((count, 3, 3)),
                np.zeros((count, 3, 3)),
            )
        weight, direction = looks(sighting, faces, partners, closed=closed)
        weights.append(weight.astype(np.float32))  # a long video has hundreds of views
        directions.append(direction.astype(np.float32))
        _add_moments(weights[-1], directions[-1], moments, passes)
    if not weights:
        return None
    weight, direction = np.stack(weights), np.stack(directions)
    total = weight.sum(axis=0, dtype=np.float64)
    moments /= np.maximum(total, 1e-12)[:, None, None]
    return Coverage(len(weights), total, _spread(weight, direction), moments, passes / len(weights))


@kernel
def _add_moments(
    weight: NDArray[np.float32], direction: NDArray[np.float32], moments: Floats, passes: Floats
) -> None:
    """Adds a view's d d^t at each place, `[V, 3, 3]`: weighed, and plain."""
    for v in range(len(weight)):
        for i in range(3):
            for j in range(3):
                product = np.float64(direction[v, i]) * np.float64(direction[v, j])
                moments[v, i, j] += weight[v] * product
                passes[v, i, j] += product


def looks(
    sighting: Sighting, faces: NDArray[np.integer], partners: Ints | None = None, *, closed: bool = False
) -> tuple[Floats, Floats]:
    """Returns how much one view shows of each place, and from where.

    Args:
        sighting: the view.
        faces: triangles, `[F, 3]`.
        partners: the vertex at the other end of each place's edge, `[V]`; None: it is looked for.
        closed: as in `nearest_faces`.

    Returns:
        cosines `[V]`, 0 where a place is not seen, and directions to the camera in the frame of each place, `[V, 3]`:
        along an edge, across it, along the normal.
    """
    points, visible = sighting.vertices, sighting.visible
    height, width = visible.shape
    pixels, depths = sighting.pixels, sighting.depths
    if partners is None:
        partners = _partners(len(points), faces)
    direction = np.empty_like(points)
    _fill_directions(points, vertex_normals(points, faces), partners, sighting.centre, direction)
    cosine, (x, y) = direction[:, 2], pixels.T
    # comparisons before the conversion to integers: coordinates may be huge
    inside = (depths > NEAR) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    shown = inside & (cosine > GRAZING)
    column, row = np.floor(pixels[shown]).astype(np.int64).T
    nearest = nearest_faces(pixels, depths, faces, width, height, closed=closed).depth[row, column]
    slope = np.sqrt(1.0 - np.minimum(cosine[shown], 1.0) ** 2) / cosine[shown]
    slack = SLACK + np.sqrt(0.5) * depths[shown] / sighting.focal * slope
    shown[shown] = visible[row, column] & (depths[shown] <= nearest + slack)
    return np.where(shown, cosine, 0.0), direction


@kernel
def _fill_directions(points: Floats, normals: Floats, partners: Ints, centre: Floats, out: Floats) -> None:
    """Gives the unit direction from each place to a point, in the place's frame (`surface_frames`)."""
    for v in range(len(points)):
        nx, ny, nz, p = normals[v, 0], normals[v, 1], normals[v, 2], partners[v]
        edge_x, edge_y, edge_z = (
            points[p, 0] - points[v, 0],
            points[p, 1] - points[v, 1],
            points[p, 2] - points[v, 2],
        )
        along = edge_x * nx + edge_y * ny + edge_z * nz
        edge_x, edge_y, edge_z = edge_x - along * nx, edge_y - along * ny, edge_z - along * nz
        length = max(math.sqrt(edge_x * edge_x + edge_y * edge_y + edge_z * edge_z), 1e-12)
        edge_x, edge_y, edge_z = edge_x / length, edge_y / length, edge_z / length
        x, y, z = centre[0] - points[v, 0], centre[1] - points[v, 1], centre[2] - points[v, 2]
        away = max(math.sqrt(x * x + y * y + z * z), 1e-12)
        x, y, z = x / away, y / away, z / away
        out[v, 0] = edge_x * x + edge_y * y + edge_z * z
        out[v, 1] = (
            (ny * edge_z - nz * edge_y) * x
            + (nz * edge_x - nx * edge_z) * y
            + (nx * edge_y - ny * edge_x) * z
        )
        out[v, 2] = nx * x + ny * y + nz * z


def surface_frames(points: Floats, faces: NDArray[np.integer]) -> Floats:
    """Returns a frame fixed to each place of a surface, `[V, 3, 3]`: rows are an edge in the plane, across, normal.

    The edge goes to the next corner of the first triangle that has the place; a place without one has zeros.

    Args:
        points: `[V, 3]`.
        faces: `[F, 3]`.
    """
    normal = vertex_normals(points, faces)
    edge = points[_partners(len(points), faces)] - points
    edge -= normal * (edge * normal).sum(axis=1, keepdims=True)
    edge /= np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-12)
    return np.stack([edge, np.cross(normal, edge), normal], axis=1)


def _partners(count: int, faces: NDArray[np.integer]) -> Ints:
    partners = np.arange(count)
    corners, first = np.unique(faces.ravel(), return_index=True)
    partners[corners] = faces[first // 3, (first + 1) % 3]
    return partners


def _spread(weight: NDArray[np.floating], direction: NDArray[np.floating]) -> Floats:
    """Returns the angle about the mean direction that holds `MOST` of the looks, `[V]`, degrees."""
    mean = np.einsum("tv,tvi->vi", weight, direction)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    angle = np.degrees(np.arccos(np.clip(np.einsum("tvi,vi->tv", direction, mean), -1.0, 1.0)))
    order = np.argsort(angle, axis=0)
    share = np.cumsum(np.take_along_axis(weight, order, axis=0), axis=0, dtype=np.float64)
    enough = (share >= MOST * share[-1] - 1e-9).argmax(axis=0)
    spread = np.take_along_axis(np.take_along_axis(angle, order, axis=0), enough[None], axis=0)[0]
    return np.where(share[-1] > 0, spread, np.nan)


def vertex_areas(points: Floats, faces: NDArray[np.integer]) -> Floats:
    """Returns the area that belongs to each vertex, `[V]`: a third of its triangles'."""
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6.0
    return np.bincount(faces.ravel(), np.repeat(area, 3), minlength=len(points)).astype(np.float64)


def class_picture(
    classes: NDArray[np.int8], seen: ZBuffer, faces: NDArray[np.integer], mask: NDArray[np.bool_]
) -> NDArray[np.int8] | None:
    """Returns the class of the place that each pixel of a person shows, `[H, W]`, -1 outside of the mask.

    Clothes and hair beyond the body's outline take the class of the nearest pixel that shows the body. None where the
    body is not in the picture.

    Args:
        classes: of the vertices, `[V]`.
        seen: the body in the picture.
        faces: triangles, `[F, 3]`.
        mask: the person, bool `[H, W]`.
    """
    body = seen.face != NO_FACE
    if not body.any():
        return None
    corner = seen.barycentrics.argmax(axis=2)
    own = classes[faces[seen.face, corner]]  # nonsense where there is no face, and never read there
    nearest = own.ravel()[nearest_set(body)]
    return np.where(mask, nearest, -1).astype(np.int8)
