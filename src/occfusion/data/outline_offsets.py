"""How far the person stands off the projected body along its outline, and the camera correction for it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.camera import project_vertices
from occfusion.geometry.outlines import outline_offsets
from occfusion.geometry.sampled_mesh import SampledMesh
from occfusion.geometry.winding import is_closed
from occfusion.types import Camera


@dataclass(frozen=True)
class Correction:
    """What a camera's intrinsics lack; applied by `corrected`.

    Attributes:
        shift: of the principal point, x and y, pixels of the picture that the camera is of.
        scale: of the focal lengths, less 1.
    """

    shift: tuple[float, float] = (0.0, 0.0)
    scale: float = 0.0

    @property
    def is_none(self) -> bool:
        """Whether it changes nothing."""
        return not any((*self.shift, self.scale))

    def resized(self, factor: float) -> Correction:
        """Returns it for the picture made larger by `factor`."""
        return Correction((self.shift[0] * factor, self.shift[1] * factor), self.scale)

    def corrected(self, camera: Camera) -> Camera:
        """Returns the camera with its intrinsics corrected."""
        if self.is_none:
            return camera
        K = camera.K.clone()
        K[[0, 1], [0, 1]] *= 1.0 + self.scale
        K[:2, 2] += K.new_tensor(self.shift)
        return Camera(camera.viewmat, K, camera.width, camera.height)


NONE = Correction()


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

REACH = 0.04
"""Of the person's size in the picture: farther edges are not this outline's."""


@dataclass(frozen=True)
class View:
    """A posed body before a camera, and the mask there.

    Attributes:
        group: what errors are alike in: the frame's place in time, or the camera's number.
        vertices: in the world, `[V, 3]`, metres.
        camera: at the size of the mask, as calibrated.
        mask: of the visible person, `[H, W]`.
    """

    group: int
    vertices: Floats
    camera: Camera
    mask: NDArray[np.bool_]


@dataclass(frozen=True)
class Offsets:
    """Points of outlines of many views, `[N]` each.

    `fields` are the pixels by which a unit of each unknown moves a point along its normal, `[N, 3]`: shift in x,
    shift in y, scale. `moves` are those by which a metre along each axis of the world does. `size` is the person's in
    the picture, pixels.
    """

    fields: Floats
    moves: Floats
    offsets: Floats
    vertices: Ints
    pixels_per_metre: Floats
    groups: Ints
    size: float

    def __len__(self) -> int:
        return len(self.offsets)


def measure_offsets(views: Iterable[View], faces: Ints, correction: Correction) -> Offsets:
    """Returns where the masks of views have their outline, beside that of the projected body.

    Args:
        views: of one or more cameras.
        faces: of the body, `[F, 3]`.
        correction: of the cameras; offsets are measured from there.
    """
    parts: list[tuple[Any, ...]] = []
    closed: bool | None = None
    for view in views:
        closed = is_closed(view.vertices, faces) if closed is None else closed
        camera = correction.corrected(view.camera)
        viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
        pixels, depth = project_vertices(view.vertices, viewmat, K)
        ahead = pixels[(depth > 0.01) & np.isfinite(pixels).all(axis=1)]
        size = float(np.ptp(ahead, axis=0).max()) if len(ahead) else 0.0
        box = _window(ahead, view.mask.shape, REACH * size)
        if box is None:
            continue
        left, top, width, height = box
        drawn = SampledMesh.draw(pixels, depth, faces, box, closed=closed)
        found = outline_offsets(
            drawn.coverage, view.mask[top : top + height, left : left + width], max(REACH * size, 3.0)
        )
        vertices = faces[drawn.face_at(found.pixels), 0]
        to_point = found.points + np.array([left, top]) - K[:2, 2]
        scale = (to_point * found.normals).sum(axis=1)
        per_metre = K[0, 0] / depth[vertices]
        # the derivative of a projected point by its place in the world, along the normal
        moves = per_metre[:, None] * (
            found.normals @ viewmat[:2, :3] - (scale / K[0, 0])[:, None] * viewmat[2, :3]
        )
        fields = np.column_stack([found.normals, scale])
        group = np.full(len(vertices), view.group)
        parts.append((fields, moves, found.offsets, vertices, per_metre, group, size))
    if not parts:
        none, nowhere = np.zeros(0), np.zeros((0, 3))
        return Offsets(nowhere, nowhere, none, none.astype(int), none, none.astype(int), 0.0)
    fields, moves, offsets, vertices, metre, groups = (
        np.concatenate([p[k] for p in parts]) for k in range(6)
    )
    size = float(np.median([part[6] for part in parts]))
    return Offsets(fields, moves, offsets, vertices, metre, groups, size)


def _window(ahead: Floats, shape: tuple[int, ...], margin: float) -> tuple[int, int, int, int] | None:
    """Returns the part of the picture about points, x, y, width, height; None where they are out of it."""
    if not len(ahead):
        return None
    limits = np.array([shape[1], shape[0]], dtype=np.float64)
    low = np.clip(np.floor(ahead.min(axis=0) - margin - 4), 0, limits).astype(int)
    high = np.clip(np.ceil(ahead.max(axis=0) + margin + 4), 0, limits).astype(int)
    width, height = (int(value) for value in high - low)
    return (int(low[0]), int(low[1]), width, height) if min(width, height) > 4 else None
