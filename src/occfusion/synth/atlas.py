"""The texture atlas: which place of the body each texel paints, and the filling of what none paints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.zbuffer import rasterize_mesh
from occfusion.synth.fullbody import HAIR, LEFT_EYE, RIGHT_EYE, SKIN, SKIRT, load_full_body
from occfusion.synth.rotations import Floats

SIZE = 1024  # texels a side; about 1.7 mm of a grown person's skin each
COARSEST = 4  # halvings of it that small pictures may ask for
LAYERS = 2  # skin; and everything else, each in a window of its own
WINDOWS = {  # x, y, width, height in layer 1, shares of it
    SKIRT: (0.0, 0.0, 0.6, 0.6),
    HAIR: (0.0, 0.62, 0.6, 0.36),
    LEFT_EYE: (0.65, 0.0, 0.15, 0.15),
    RIGHT_EYE: (0.82, 0.0, 0.15, 0.15),
}
MARGIN = 0.01


@dataclass(frozen=True)
class Unwrapping:
    """Where the faces of the full body lie in the texture.

    Attributes:
        uv: texture coordinates of each corner of each face, `[F, 3, 2]`, 0..1.
        layer: layer of each face, `[F]`.
    """

    uv: Floats
    layer: NDArray[np.int64]


@dataclass(frozen=True)
class Atlas:
    """The place of each texel.

    Attributes:
        side: texels a side of a layer.
        texels: flat index into `[LAYERS, side, side]` of each texel that paints something, `[N]`.
        points: its place on the template, `[N, 3]`, metres.
        group: its group (`fullbody.GROUPS`), `[N]`.
    """

    side: int
    texels: NDArray[np.int64]
    points: Floats
    group: NDArray[np.int64]


@cache
def load_unwrapping() -> Unwrapping:
    """Returns where faces lie in the texture: all that geometry wants of it."""
    body = load_full_body()
    uv = body.uv[body.face_uv]
    layer = np.where(body.face_group == SKIN, 0, 1)
    for group, (x, y, width, height) in WINDOWS.items():
        own = body.face_group == group
        low, high = uv[own].min((0, 1)), uv[own].max((0, 1))
        uv[own] = (uv[own] - low) / (high - low) * [width - MARGIN, height - MARGIN] + [x, y] + 0.5 * MARGIN
    return Unwrapping(uv, layer)


@cache
def load_atlas(side: int) -> Atlas:
    """Returns the atlas with layers of `side` x `side` texels; kept until a scene is written (0.3 s to make)."""
    body, unwrapping = load_full_body(), load_unwrapping()
    texels, points, groups = [], [], []
    for k in range(LAYERS):
        own = np.flatnonzero(unwrapping.layer == k)
        corners = unwrapping.uv[own].reshape(-1, 2) * side
        seen = rasterize_mesh(
            corners, np.ones(len(corners)), np.arange(len(corners)).reshape(-1, 3), side, side
        )
        flat = np.flatnonzero(seen.face.ravel() >= 0)
        face = own[seen.face.ravel()[flat]]
        weights = seen.barycentrics.reshape(-1, 3)[flat].astype(np.float64)
        texels.append(flat + k * side * side)
        points.append(np.einsum("nk,nkd->nd", weights, body.template[body.faces[face]]))
        groups.append(body.face_group[face])
    return Atlas(side, np.concatenate(texels), np.concatenate(points), np.concatenate(groups))


def halvings(texel: float) -> int:
    """Returns how often the atlas may be halved for texels of `texel` times its own width."""
    return int(np.clip(np.floor(np.log2(max(texel, 1.0))), 0, COARSEST))


def fill(atlas: Atlas, colours: Floats, halve: int) -> NDArray[np.float32]:
    """Returns the texture as a stack of images, `[LAYERS, S, S, 3]`, halved `halve` times.

    Unpainted texels take the mean of painted ones near them (pull-push), so that filtering across the
    edge of an island does not bring in black.

    Args:
        atlas: the atlas.
        colours: of its texels, `[N, 3]`.
        halve: how often to average 2 x 2 texels.
    """
    image = np.zeros((LAYERS * atlas.side**2, 4), np.float32)
    image[atlas.texels, :3] = colours
    image[atlas.texels, 3] = 1.0
    layers = image.reshape(LAYERS, atlas.side, atlas.side, 4)
    return np.ascontiguousarray(np.stack([_pull_push(layer)[halve] for layer in layers]))


def _pull_push(image: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Returns the filled image at every resolution, finest first, each `[S, S, 3]`."""
    pyramid = [image]
    while pyramid[-1].shape[0] > 1:
        fine = pyramid[-1]
        half = fine.shape[0] // 2
        total = fine.reshape(half, 2, half, 2, 4).sum((1, 3))
        colour = np.where(total[..., 3:] > 0, total[..., :3] / np.maximum(total[..., 3:], 1e-6), 0.0)
        known = (total[..., 3:] > 0).astype(np.float32)
        pyramid.append(np.concatenate([colour * known, known], axis=2).astype(np.float32))
    filled = [pyramid[-1][..., :3]]
    for level in reversed(pyramid[:-1]):
        side = level.shape[0]
        wide = cv2.resize(filled[-1], (side, side), interpolation=cv2.INTER_LINEAR).reshape(side, side, 3)
        filled.append(np.where(level[..., 3:] > 0, level[..., :3], wide).astype(np.float32))
    return filled[::-1]
