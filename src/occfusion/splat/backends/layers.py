"""What a backend hands back to `rasterize`."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Layers(NamedTuple):
    """The blended crop.

    Attributes:
        rgb: over the background, `[h, w, 3]`.
        alpha: `[h, w]`.
        depth: expected depth, `[h, w]`, metres; 0 where alpha is 0.
        radii: half extents of each splat in pixels, `[N, 2]`, 0 where culled; no gradient.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    radii: Tensor
