"""What a backend hands back to `rasterize`."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Layers(NamedTuple):
    """The blended crop over black.

    Attributes:
        rgb: `[h, w, 3]`.
        alpha: `[h, w]`.
        weighted_depth: sum of weight times depth, `[h, w]`, metres.
        radii: half extents of each splat in pixels, `[N, 2]`, 0 where culled; no gradient.
    """

    rgb: Tensor
    alpha: Tensor
    weighted_depth: Tensor
    radii: Tensor
