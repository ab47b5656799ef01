"""The pictures that the embedded inpainter sees of a partly hidden person, in a square crop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.camera import project_vertices
from occfusion.inpaint.partial import Partial
from occfusion.priors.bodyview import view_body
from occfusion.priors.crop import Square

SIZE = 256
"""Pixels a side of the crop."""
PLANES = (
    "coarse_r", "coarse_g", "coarse_b", "alpha", "gathered_r", "gathered_g", "gathered_b", "seen", "rgb_r", "rgb_g",
    "rgb_b", "visible", "complete", "body", "depth",
)  # fmt: skip
COARSE, GATHERED, OBSERVED = slice(0, 3), slice(4, 7), slice(8, 11)
ALPHA, SEEN, VISIBLE, COMPLETE, BODY, DEPTH = 3, 7, 11, 12, 13, 14
"""Where each stands in `PLANES`; `depth` is relative, in -1..1, all others lie in 0..1."""

Planes = NDArray[np.float32]


def take_planes(partial: Partial, size: int = SIZE) -> tuple[Square, Planes]:
    """Returns the square around the body, and the planes of `PLANES` in it, `[15, size, size]`."""
    observation = partial.observation
    camera = observation.camera
    viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    pixels, depths = project_vertices(observation.vertices, viewmat, K)
    square = Square.around(pixels[depths > 0.01])
    window = square.camera(camera, size)
    body = view_body(
        *project_vertices(observation.vertices, viewmat, window.K.numpy()), observation.faces, size, size
    )
    whole = np.concatenate(
        [
            partial.coarse, partial.alpha[..., None], partial.gathered, partial.seen[..., None],
            np.where(observation.visible[..., None], observation.rgb, 0.0), observation.visible[..., None],
            partial.complete[..., None],
        ],
        axis=-1, dtype=np.float32,
    )  # fmt: skip
    taken = [square.take(whole[..., k], size) for k in range(whole.shape[-1])]
    return square, np.stack([*taken, body.coverage, body.relative_depth]).astype(np.float32)


def take_picture(square: Square, picture: NDArray[np.floating], size: int = SIZE) -> Planes:
    """Returns a picture `[H, W, C]` in the square, `[C, size, size]`."""
    taken = [square.take(picture[..., k].astype(np.float32), size) for k in range(picture.shape[-1])]
    return np.stack(taken)
