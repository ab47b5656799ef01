"""A closed, opaque surface where a video does not say what is there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.geometry.rotation import quaternion_to_matrix
from occfusion.human.avatar import Avatar
from occfusion.human.observability import CanonicalView, Observability, dressed_heights
from occfusion.human.rendering import Renderer
from occfusion.settings.stages import SurfaceSettings
from occfusion.types import Cloud

DEPTH_SCALE = 0.010
"""Metres that a Gaussian may stand off the dressed body, along a direction of which nothing is known, before it
counts."""
EXTENT_SCALE = 0.005
"""Standard deviation along it, metres, likewise."""

OUTWARDS, INWARDS = 0.005, 0.015
"""Metres that a Gaussian may stand outside of clothes, and inside the body, where nothing is known of its depth."""
THICK, LONG = 0.002, 0.006
"""Standard deviation that it may have there across the surface, and along the direction of which nothing is known;
vertices of a body are about 0.017 m apart."""
HELD_FROM = 0.2
"""Ignorance from which on a Gaussian is bounded."""


class SurfacePrior:
    """Makes the terms that hold Gaussians to the body where the video leaves them free.

    What was seen from many directions is left alone: each term is weighted by what the video does not say.

    - `depth`: how far a Gaussian stands off the dressed body along the direction of which least is known.
    - `extent`: how far it reaches along it: a needle that is seen from its end.
    - `outline`: the occupancy of the canonical pose, from a side, against body and clothes: nothing outside, no hole.
    - `backface`: what of the body's other side shines through places that no frame shows.

    Args:
        known: what the video says of the surface.
        normals: of the canonical body, `[V, 3]`.
        thickness: how far clothes stand off at each place, `[V]`, metres.
        views: of the canonical body; used only where `outline` or `backface` have a weight.
        settings: weights, in multiples of the colours' L1.
        renderer: draws the canonical views.
        seed: decides which view is taken, step by step.
    """

    def __init__(
        self,
        known: Observability,
        normals: NDArray[np.float64],
        thickness: NDArray[np.float64],
        views: Sequence[CanonicalView],
        settings: SurfaceSettings,
        *,
        renderer: Renderer,
        seed: int,
    ) -> None:
        self.settings = settings
        self.renderer = renderer
        self.seed = seed
        self._views = [view.to(renderer.device) for view in views]
        dressed = dressed_heights(thickness, known)[:, None] * normals
        self._axis, self._ignorance, self._normal, self._dressed, self._thickness = (
            torch.from_numpy(values).float().to(renderer.device)
            for values in (known.axis, known.ignorance, normals, dressed, np.maximum(thickness, 0.0))
        )

    def weight(self, name: str) -> float:
        """Returns the weight of a term; every k-th step at k times the weight leaves the expected gradient as it is."""
        own: float = getattr(self.settings, name.removeprefix("surface_"))
        return own * self.settings.every if name in ("surface_outline", "surface_backface") else own

    def terms(self, avatar: Avatar, step: int) -> Mapping[str, Tensor]:
        """Returns the terms of a step, unweighted: `surface_` and their names; those of weight zero are not built."""
        settings = self.settings
        terms: dict[str, Tensor] = {}
        rows = avatar.gaussians.vertex_index
        axis, ignorance = self._axis[rows], self._ignorance[rows]
        if settings.depth:
            surface = avatar.da_vertices[rows] + self._dressed[rows]
            off = ((avatar.gaussians.means - surface) * axis).sum(dim=1) / DEPTH_SCALE
            terms["surface_depth"] = (ignorance * _beyond(off.square())).mean()
        if settings.extent:
            along = (avatar.gaussians.roots() * axis[:, :, None]).sum(dim=1) / EXTENT_SCALE
            terms["surface_extent"] = (ignorance * _beyond(along.square().sum(dim=1))).mean()
        if (settings.outline or settings.backface) and step % settings.every == 0:
            terms |= self._seen_from_a_side(avatar, step)
        return terms

    @torch.no_grad()
    def hold(self, avatar: Avatar) -> None:
        """Brings Gaussians back that left the room that the video gives them; changes them in place.

        A penalty that is weighed against colours is paid by those that a wrong pose pulls hardest. Bounds are not: in
        units of what is allowed where nothing is known, the room grows as the ignorance falls.
        """
        gaussians = avatar.gaussians
        rows = gaussians.vertex_index
        held = (self._ignorance[rows] >= HELD_FROM).nonzero()[:, 0]
        if not self.settings.hold or len(held) == 0:
            return
        rows = rows[held]
        room, normal, axis = 1.0 / self._ignorance[rows], self._normal[rows], self._axis[rows]
        means = gaussians.means[held]
        height = ((means - avatar.da_vertices[rows]) * normal).sum(dim=1)
        allowed = height.clamp(min=-INWARDS * room, max=self._thickness[rows] + OUTWARDS * room)
        gaussians.means[held] = means + (allowed - height)[:, None] * normal
        turns = quaternion_to_matrix(gaussians.raw_quats[held])
        across, along = ((turns * direction[:, :, None]).sum(dim=1).abs() for direction in (normal, axis))
        longest = room[:, None] * torch.minimum(THICK / across.clamp(min=1e-3), LONG / along.clamp(min=1e-3))
        gaussians.log_scales[held] = torch.minimum(gaussians.log_scales[held], longest.log())

    def _seen_from_a_side(self, avatar: Avatar, step: int) -> dict[str, Tensor]:
        generator = torch.Generator().manual_seed(self.seed * 1_000_039 + step)
        view = self._views[int(torch.randint(len(self._views), (), generator=generator))]
        gaussians = avatar.gaussians
        roots = gaussians.roots()
        # of the picture's three channels, one says what share of a pixel shows the body's other side
        away = torch.zeros_like(gaussians.means)
        away[:, 0] = view.is_away[gaussians.vertex_index]
        cloud = Cloud(
            gaussians.means, roots @ roots.transpose(1, 2), gaussians.opacities, away, avatar.dilation
        )
        drawn = self.renderer.draw(cloud, view.camera)
        area = view.body.sum().clamp(min=1.0)
        terms = {}
        if self.settings.outline:
            terms["surface_outline"] = (view.weight * (drawn.alpha - view.body).square()).sum() / area
        if self.settings.backface:
            terms["surface_backface"] = (view.unseen * drawn.rgb[..., 0].square()).sum() / area
        return terms


def _beyond(squares: Tensor) -> Tensor:
    """Returns sqrt(1 + x^2) - 1 of squares x^2: half of them where they are small, and no faster than x far out."""
    return (1.0 + squares).sqrt() - 1.0
