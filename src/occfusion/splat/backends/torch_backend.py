"""The `torch` backend: any device, float32 and float64. It is the specification of the others."""

from __future__ import annotations

import torch
from torch import Tensor

from occfusion.splat.backends.torch_blend import Blend
from occfusion.splat.harmonics import evaluate
from occfusion.splat.projection import Splats, project
from occfusion.splat.request import Request
from occfusion.splat.tiles import bin_splats
from occfusion.types import Rendering

TILE = 8
"""Pixels. Small tiles waste fewer (splat, pixel) pairs; 16 takes 1.7 times as long."""


def render(request: Request, tile: int = TILE) -> Rendering:
    """Returns the crop of the picture; the tile size changes the speed alone."""
    splats = project(request)
    colors = visible_colors(request, splats.index)
    lists = bin_splats(splats, request.crop, tile, request.limits.alpha_min)
    features = torch.cat([colors, splats.depths[:, None], torch.ones_like(splats.depths)[:, None]], dim=1)
    rgb, alpha, weighted_depth = Blend.apply(
        splats.means2d, splats.factors, splats.opacities, features, lists, request.crop, request.limits
    )
    return finish(request, splats, rgb, alpha, weighted_depth)


def visible_colors(request: Request, index: Tensor) -> Tensor:
    """Returns the colours `[V, 3]` of the visible Gaussians as the camera sees them."""
    colors = request.colors.index_select(0, index)
    if request.sh_degree is None:
        return colors
    centre = -request.viewmat[:3, :3].T @ request.viewmat[:3, 3]
    rays = request.means.index_select(0, index) - centre
    return evaluate(colors, rays / rays.norm(dim=-1, keepdim=True), request.sh_degree)


def finish(request: Request, splats: Splats, rgb: Tensor, alpha: Tensor, weighted_depth: Tensor) -> Rendering:
    """Returns the layers: the background behind, depth as a mean over what covers the pixel."""
    if request.background is not None:
        rgb = rgb + (1 - alpha)[..., None] * request.background
    depth = weighted_depth / torch.where(alpha > 0, alpha, 1.0)
    radii = request.means.new_zeros(len(request.means), 2).index_copy(0, splats.index, splats.extents)
    return Rendering(rgb, alpha, depth, radii)
