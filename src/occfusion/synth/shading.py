"""Pictures of textured meshes: z-buffer at twice the resolution, texture times light, box filter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from occfusion.cpu.compilation import serial, step
from occfusion.geometry.zbuffer import ZBuffer, rasterize_mesh
from occfusion.synth.rotations import Floats

SUPERSAMPLING = 2  # samples a side of each pixel
PADDING = 2  # pixels round the projected mesh
WHITE = 255.0


class Window(NamedTuple):
    """What a mesh contributes to a part of a picture, at sample resolution.

    Attributes:
        x: first column, pixels.
        y: first row, pixels.
        depth: `[h * 2, w * 2]`, metres, infinite where nothing is.
        colour: `[h * 2, w * 2, 3]`, 0..255.
    """

    x: int
    y: int
    depth: NDArray[np.float32]
    colour: NDArray[np.float32]


class Mesh(NamedTuple):
    """A textured and lit mesh in the world.

    Attributes:
        vertices: `[V, 3]`, metres.
        light: brightness at the vertices, `[V]`.
        faces: `[F, 3]`.
        uv: texture coordinates of the corners, `[F, 3, 2]`.
        layer: texture layer of each face, `[F]`.
        texture: `[L, S, S, 3]`, 0..1.
    """

    vertices: Floats
    light: Floats
    faces: NDArray[np.int64]
    uv: Floats
    layer: NDArray[np.int64]
    texture: NDArray[np.float32]


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


class Sampled(NamedTuple):
    """Where a mesh lies in a picture, at sample resolution.

    Attributes:
        x: first column of the window, pixels.
        y: first row, pixels.
        zbuffer: of the window's samples.
    """

    x: int
    y: int
    zbuffer: ZBuffer


def draw(mesh: Mesh, viewmat: Floats, K: Floats, size: int) -> Window | None:
    """Returns what a camera of `size` x `size` pixels sees of a mesh, or None where that is nothing."""
    found = sample(mesh.vertices, mesh.faces, viewmat, K, size)
    if found is None:
        return None
    light = np.repeat(mesh.light[:, None], 3, axis=1)
    lit = LinearMesh(mesh.vertices, light, np.zeros_like(light), *mesh[2:])
    return _shaded(found, lit, WHITE, WHITE)


def sample(
    vertices: Floats, faces: NDArray[np.int64], viewmat: Floats, K: Floats, size: int
) -> Sampled | None:
    """Returns which surface the samples of a camera of `size` x `size` pixels see; None where they see none."""
    local = vertices @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = local[:, 2]
    ahead = depth > 0.05
    if not ahead.any():
        return None
    pixels = (local @ K.T)[:, :2] / np.where(ahead, depth, 1.0)[:, None]
    low = np.floor(pixels[ahead].min(0)) - PADDING
    high = np.ceil(pixels[ahead].max(0)) + PADDING
    left, top = (int(v) for v in np.clip(low, 0, size))
    right, bottom = (int(v) for v in np.clip(high, 0, size))
    if right <= left or bottom <= top:
        return None
    samples = (pixels - [left, top]) * SUPERSAMPLING
    shape = (right - left) * SUPERSAMPLING, (bottom - top) * SUPERSAMPLING
    return Sampled(left, top, rasterize_mesh(samples, np.where(ahead, depth, -1.0), faces, *shape))


def _shaded(found: Sampled, mesh: LinearMesh, white: float, limit: float) -> Window:
    seen = found.zbuffer
    colour = np.zeros((*seen.depth.shape, 3), np.float32)
    _shade(
        seen.face, seen.barycentrics, mesh.faces, mesh.light.astype(np.float32), mesh.shine.astype(np.float32),
        mesh.uv.astype(np.float32), mesh.layer, mesh.texture, white, limit, colour,
    )  # fmt: skip
    return Window(found.x, found.y, seen.depth, colour)


@serial
def _shade(
    face: NDArray[np.int32],
    barycentrics: NDArray[np.float32],
    faces: NDArray[np.int64],
    light: NDArray[np.float32],
    shine: NDArray[np.float32],
    uv: NDArray[np.float32],
    layer: NDArray[np.int64],
    texture: NDArray[np.float32],
    white: float,
    limit: float,
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
                value = white * brightness * bilinear(texture[layer[f]], i, j, ty, tx, c) + added
                out[row, column, c] = min(value, limit)


@step
def texel(
    weights: NDArray[np.float32], corners: NDArray[np.float32], size: int
) -> tuple[int, int, float, float]:
    """Returns row and column of the texel above and left of a place on a face, and the shares of the next ones."""
    u, v = 0.0, 0.0
    for k in range(3):
        u += weights[k] * corners[k, 0]
        v += weights[k] * corners[k, 1]
    # texel centres lie at +0.5
    x = min(max(u * size - 0.5, 0.0), size - 1.001)
    y = min(max(v * size - 0.5, 0.0), size - 1.001)
    i, j = int(y), int(x)
    return i, j, y - i, x - j


@step
def bilinear(page: NDArray[np.float32], i: int, j: int, ty: float, tx: float, c: int) -> float:
    """Returns channel `c` of a layer between four texels."""
    upper = (1.0 - tx) * page[i, j, c] + tx * page[i, j + 1, c]
    lower = (1.0 - tx) * page[i + 1, j, c] + tx * page[i + 1, j + 1, c]
    return (1.0 - ty) * upper + ty * lower


def draw_linear(mesh: LinearMesh, viewmat: Floats, K: Floats, size: int) -> Window | None:
    """Returns what a camera of `size` x `size` pixels sees of a mesh in linear light; None: nothing.

    Texture times a coloured factor, and highlights, without a limit; 1 is a white page under the sky.
    """
    found = sample(mesh.vertices, mesh.faces, viewmat, K, size)
    if found is None:
        return None
    return _shaded(found, mesh, 1.0, np.inf)


@serial
def lay_over(
    picture: NDArray[np.float32],
    coverage: NDArray[np.float32],
    x: int,
    y: int,
    depth: NDArray[np.float32],
    colour: NDArray[np.float32],
    before: NDArray[np.float32],
    before_colour: NDArray[np.float32],
) -> None:
    """Lays a person over a background, and things in front over the person, sample by sample.

    Args:
        picture: background on entry, the picture on return, `[H, W, 3]`, 0..255.
        coverage: share of each pixel's samples that show the person, `[H, W]`; written.
        x: first column of the window.
        y: first row of the window.
        depth: of the person, samples of the window.
        colour: of the person, samples of the window.
        before: depth of the things in front, samples of the window; infinite where there are none.
        before_colour: their colour, `[h, w, 3]`, samples of the window.
    """
    height, width = depth.shape[0] // 2, depth.shape[1] // 2
    for row in range(height):
        for column in range(width):
            r, g, b, seen, left = 0.0, 0.0, 0.0, 0, 0
            for dy in range(2):
                for dx in range(2):
                    i, j = 2 * row + dy, 2 * column + dx
                    if depth[i, j] < before[i, j]:
                        seen += 1
                        r += colour[i, j, 0]
                        g += colour[i, j, 1]
                        b += colour[i, j, 2]
                    elif before[i, j] < np.inf:
                        r += before_colour[i, j, 0]
                        g += before_colour[i, j, 1]
                        b += before_colour[i, j, 2]
                    else:
                        left += 1
            share = 0.25 * left
            picture[y + row, x + column, 0] = 0.25 * r + share * picture[y + row, x + column, 0]
            picture[y + row, x + column, 1] = 0.25 * g + share * picture[y + row, x + column, 1]
            picture[y + row, x + column, 2] = 0.25 * b + share * picture[y + row, x + column, 2]
            coverage[y + row, x + column] = 0.25 * seen
