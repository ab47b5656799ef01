"""The optimisation stage: human Gaussians from what is seen, and from a prior (paper §4.2; §3.3 for `A`)."""

from __future__ import annotations

from typing import Any

from torch import Tensor, ones_like

from occfusion.geometry.boxes import crop
from occfusion.human.avatar import Avatar
from occfusion.quality import losses
from occfusion.settings.stages import OptimSettings
from occfusion.stages.avatar import AvatarStage
from occfusion.stages.distil import Distiller
from occfusion.stages.targets import Target, UncertainMasks, crop_frame, mask_weights
from occfusion.types import Box, Frame, Rendering


class OptimStage(AvatarStage):
    """Fits the avatar to the visible pixels and the masks.

    Terms of weight zero are not built: without `lambda_lpips` no network is loaded, and none is asked for here.

    Args:
        avatar: the avatar to train, in place.
        settings: weights, schedules and rates.
        distiller: score distillation; None where none of its terms has a weight.
        uncertain: where complete masks may be wrong; asked only where `settings.hidden` counts them less than fully.
        shared: what every `AvatarStage` takes.
    """

    name = "optim"

    def __init__(
        self,
        avatar: Avatar,
        settings: OptimSettings,
        *,
        distiller: Distiller[Any] | None = None,
        uncertain: UncertainMasks | None = None,
        **shared: Any,
    ) -> None:
        super().__init__(avatar, settings, **shared)
        self.settings = settings
        self.distiller = distiller
        self.uncertain = uncertain or UncertainMasks()

    def terms(self, frame: Frame, rendering: Rendering, box: Box) -> dict[str, Tensor]:
        """Returns the terms of paper §4.2: photometric ones and, with a distiller, that of the prior."""
        weights = mask_weights(frame, box, self.uncertain, self.settings.hidden.effective_weight)
        terms = self._photometric(rendering, crop_frame(frame, box), weights)
        if self.distiller is not None:
            terms |= self.distiller.terms(self.avatar, frame, rendering.alpha, box, self.global_step)
        return terms

    def _photometric(self, rendering: Rendering, target: Target, weights: Tensor | None) -> dict[str, Tensor]:
        settings = self.settings
        everywhere = settings.pixels == "all"
        pixels = ones_like(target.visible_mask) if everywhere else target.visible_mask
        terms = self.colour_terms(rendering.rgb, target.rgb, pixels)
        if settings.lambda_mask:
            terms["mask"] = losses.l2(rendering.alpha, target.mask.to(rendering.alpha.dtype), weights=weights)
        if (perceptual := self.perceptual_due()) is not None:
            # outside the visible pixels both pictures are black
            rgb = rendering.rgb if everywhere else rendering.rgb * pixels[..., None]
            box = self.perceptual_box(target.visible_mask)
            terms["lpips"] = perceptual(crop(rgb, box), crop(target.rgb, box))
        return terms

    def weight(self, name: str) -> float:
        """Returns the weight of a term; the distiller has those of its own."""
        if self.distiller is not None and name.startswith("sds_"):
            return self.distiller.weight(name)
        return super().weight(name)
