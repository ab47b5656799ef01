"""A closed, opaque surface where a video does not say what is there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.human.avatar import Avatar
from occfusion.human.gaussians import starting_sizes
from occfusion.human.observability import Observability
from occfusion.human.rendering import Renderer
from occfusion.human.surface_bounds import HELD_FROM, KnownSurface, hold
from occfusion.human.virtual_views import VirtualView
from occfusion.settings.stages import SurfaceSettings


class SurfacePrior:
    """Makes the terms that hold Gaussians to the body where the video leaves them free.

    What was seen from many directions is left alone: each term is weighted by what the video does not say.

    - `outline`: the occupancy in a pose of the video, from a side, against that of body and clothes.
    - `backface`: what of the body's other side shines through places that no frame shows.

    Args:
        known: what the video says of the surface.
        normals: of the canonical body, `[V, 3]`.
        thickness: how far clothes stand off at each place, `[V]`, metres.
        views: of the body, on the renderer's device; used only where `outline` or `backface` have a weight.
        settings: weights, in multiples of the colours' L1.
        renderer: draws the views.
        seed: decides which view is taken, step by step.
    """

    def __init__(
        self,
        known: Observability,
        normals: NDArray[np.float64],
        thickness: NDArray[np.float64],
        views: Sequence[VirtualView],
        settings: SurfaceSettings,
        *,
        renderer: Renderer,
        seed: int,
    ) -> None:
        self.settings = settings
        self.renderer = renderer
        self.seed = seed
        self._views = views
        self._compiled = renderer.backend == "numba"
        self._known: KnownSurface | None = None
        self._holds = settings.hold and bool((known.ignorance >= HELD_FROM).any())
        self._axis, self._ignorance, self._normals, self._thickness = (
            torch.from_numpy(values).float().to(renderer.device)
            for values in (known.axis, known.ignorance, normals, np.maximum(thickness, 0.0))
        )

    def weight(self, name: str) -> float:
        """Returns the weight of a term; every k-th step at k times the weight leaves the expected gradient as it is."""
        own: float = getattr(self.settings, name.removeprefix("surface_"))
        return own * self.settings.every

    def terms(self, avatar: Avatar, step: int) -> Mapping[str, Tensor]:
        """Returns the terms of a step, unweighted: `surface_` and their names; those of weight zero are not built."""
        if not self.settings.are_views_used or step % self.settings.every:
            return {}
        return self._seen_from_a_side(avatar, step)

    def hold(self, avatar: Avatar) -> None:
        """Brings Gaussians back that left the room that the video gives them; changes them in place."""
        if self._holds:
            hold(avatar.gaussians, self._surface(avatar), compiled=self._compiled)

    def _surface(self, avatar: Avatar) -> KnownSurface:
        vertices = avatar.da_vertices
        if self._known is None or self._known.vertices is not vertices:  # an avatar's body stays what it is
            self._known = KnownSurface(
                vertices,
                self._normals,
                self._thickness,
                self._axis,
                self._ignorance,
                # over the clothes: between the legs of a skirt neighbours are farther apart than on the body
                starting_sizes(vertices + self._thickness[:, None] * self._normals),
            )
        return self._known

    def _seen_from_a_side(self, avatar: Avatar, step: int) -> dict[str, Tensor]:
        generator = torch.Generator().manual_seed(self.seed * 1_000_039 + step)
        view = self._views[int(torch.randint(len(self._views), (), generator=generator))]
        gaussians = avatar.gaussians
        # of the picture's three channels, one says what share of a pixel shows the body's other side
        away = torch.zeros_like(gaussians.means)
        away[:, 0] = view.is_away[gaussians.vertex_index].to(away)
        drawn = self.renderer.posed(avatar, view.pose, away, view.camera)
        alpha, weight, unseen = (part.float() / 255.0 for part in (view.alpha, view.weight, view.unseen))
        area = alpha.sum().clamp(min=1.0)
        terms = {}
        if self.settings.outline:
            terms["surface_outline"] = (weight * (drawn.alpha - alpha).square()).sum() / area
        if self.settings.backface:
            terms["surface_backface"] = (unseen * drawn.rgb[..., 0].square()).sum() / area
        return terms
