"""Normals of triangle meshes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from occfusion.cpu.compilation import serial


def vertex_normals(points: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Returns unit normals at the vertices, `[V, 3]`: means of the face normals by area.

    They point to where the corners of the faces run counter-clockwise; a vertex without a face has 0.

    Args:
        points: `[V, 3]`.
        faces: `[F, 3]`.

    Raises:
        IndexError: a face names a vertex that does not exist.
    """
    corners = np.ascontiguousarray(faces, np.int64).reshape(-1, 3)
    if corners.size and (corners.min() < 0 or corners.max() >= len(points)):
        raise IndexError(f"faces name vertices {corners.min()}..{corners.max()} of {len(points)}")
    out = np.zeros((len(points), 3))
    _add_normals(np.ascontiguousarray(points, np.float64), corners, out)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)


@serial
def _add_normals(points: NDArray[np.float64], faces: NDArray[np.int64], out: NDArray[np.float64]) -> None:
    normals = np.empty((len(faces), 3))
    for f in range(len(faces)):
        a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            normals[f, axis] = (b[u] - a[u]) * (c[v] - a[v]) - (b[v] - a[v]) * (c[u] - a[u])
    # corner by corner, so that many small numbers are not added to one large one
    for corner in range(3):
        total = np.zeros((len(out), 3))
        for f in range(len(faces)):
            for axis in range(3):
                total[faces[f, corner], axis] += normals[f, axis]
        out += total
