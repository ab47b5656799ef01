"""Pictures of meshes in linear light: texture times a coloured factor, and highlights, without a limit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from occfusion.cpu.compilation import serial
from occfusion.synth.rotations import Floats
from occfusion.synth.shading import Window, bilinear, sample, texel


class LinearMesh(NamedTuple):
    """A textured mesh as one camera sees it lit.

    Attributes:
        vertices: `[V, 3]`, metres, world.
        light: factor on the texture at the vertices, `[V, 3]`.
        shine: what is added, `[V, 3]`.
        faces: `[F, 3]`.
        uv: texture coordinates of the corners, `[F, 3, 2]`.
        layer: texture layer of each face, `[F]`.
        texture: `[L, S, S, 3]`, linear.
    """

    vertices: Floats
    light: Floats
    shine: Floats
    faces: NDArray[np.int64]
    uv: Floats
    layer: NDArray[np.int64]
    texture: NDArray[np.float32]


def draw_linear(mesh: LinearMesh, viewmat: Floats, K: Floats, size: int) -> Window | None:
    """Returns what a camera of `size` x `size` pixels sees of a mesh, 1 a white page under the sky; None: nothing."""
    found = sample(mesh.vertices, mesh.faces, viewmat, K, size)
    if found is None:
        return None
    seen = found.zbuffer
    colour = np.zeros((*seen.depth.shape, 3), np.float32)
    _shade_linear(
        seen.face, seen.barycentrics, mesh.faces, mesh.light.astype(np.float32), mesh.shine.astype(np.float32),
        mesh.uv.astype(np.float32), mesh.layer, mesh.texture, colour,
    )  # fmt: skip
    return Window(found.x, found.y, seen.depth, colour)


@serial
def _shade_linear(
    face: NDArray[np.int32],
    barycentrics: NDArray[np.float32],
    faces: NDArray[np.int64],
    light: NDArray[np.float32],
    shine: NDArray[np.float32],
    uv: NDArray[np.float32],
    layer: NDArray[np.int64],
    texture: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    for row in range(face.shape[0]):
        for column in range(face.shape[1]):
            f = face[row, column]
            if f < 0:
                continue
            weights = barycentrics[row, column]
            i, j, ty, tx = texel(weights, uv[f], texture.shape[1])
            for c in range(3):
                brightness, added = 0.0, 0.0
                for k in range(3):
                    brightness += weights[k] * light[faces[f, k], c]
                    added += weights[k] * shine[faces[f, k], c]
                out[row, column, c] = brightness * bilinear(texture[layer[f]], i, j, ty, tx, c) + added
