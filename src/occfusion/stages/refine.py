"""The refinement stage: fine-tuning on what is seen and on what was inpainted once (paper §4.3)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from occfusion.geometry.boxes import crop, mask_bounds
from occfusion.human.avatar import Avatar
from occfusion.quality import losses
from occfusion.settings.stages import RefineSettings
from occfusion.stages.avatar import AvatarStage
from occfusion.stages.references import References
from occfusion.stages.targets import Masks, UncertainMasks, crop_frame, mask_weights, with_outline
from occfusion.types import Box, Frame, Rendering


class RefineStage(AvatarStage):
    """Fine-tunes the coarse avatar: L1 where the person is seen, and towards the references where it is not.

    Args:
        avatar: the avatar of the optimisation stage, trained on in place.
        settings: weights, schedules and rates.
        references: the inpainted frames; a frame without one shows the whole person.
        uncertain: where complete masks may be wrong.
        outlines: the avatar's own at the hand-over, which the mask term holds it to there, also where no prior was
            asked; empty: to complete masks.
        colour_shares: of the learning rate that the colours at each vertex get, `[V]`, 0..1; None: all of it.
        shared: what every `AvatarStage` takes; the steps before are those of the optimisation.
    """

    name = "refine"

    def __init__(
        self,
        avatar: Avatar,
        settings: RefineSettings,
        references: References,
        uncertain: UncertainMasks,
        outlines: Masks,
        *,
        colour_shares: Tensor | None = None,
        **shared: Any,
    ) -> None:
        super().__init__(avatar, settings, **shared)
        self.settings = settings
        self.references = references
        self._colour_shares = None if colour_shares is None else colour_shares.to(self._renderer.device)
        # no prior is asked for an outline
        self.uncertain, self.outlines = UncertainMasks(uncertain.hidden) if outlines else uncertain, outlines

    def terms(self, frame: Frame, rendering: Rendering, box: Box) -> dict[str, Tensor]:
        """Returns the terms of paper §4.3: L1 on M, L2 of the occupancy, L1 on R, and the perceptual one.

        `settings.hidden` decides how much L2 counts where the person may be hidden, but is seen by some other frame.
        """
        settings, target = self.settings, crop_frame(frame, box)
        reference = self.references.get(frame, box)
        rgb, structure = rendering.rgb, None
        if reference is not None and settings.references.perceptual:
            structure = reference.rgb, target.visible_mask | reference.region
        terms = self.colour_terms(rgb, target.rgb, target.visible_mask, structure)
        if settings.lambda_mask:
            unseen = None
            if (
                reference is not None
                and frame.complete_mask is not None
                and settings.references.pixels == "unseen"
            ):
                unseen = reference.region
            weights = mask_weights(frame, box, self.uncertain, settings.hidden.effective_weight, unseen)
            mask = with_outline(target.mask, frame, box, self.uncertain, self.outlines, unseen)
            terms["mask"] = losses.l2(rendering.alpha, mask.to(rgb.dtype), weights=weights)
        if settings.references.weight and reference is not None:
            parts: tuple[Tensor, ...] = (rgb, reference.rgb, reference.region)
            if (around := mask_bounds(reference.region)) is not None:  # often a corner of the crop
                left, top, right, bottom = around
                parts = tuple(crop(part, (left, top, right - left, bottom - top)) for part in parts)
            terms["gen"] = losses.l1(*parts)
        if (perceptual := self.perceptual_due()) is not None:
            wanted, looked_at = structure or (target.rgb, target.visible_mask)
            window = self.perceptual_box(looked_at)
            # black elsewhere in both
            shown, wanted = (crop(picture * looked_at[..., None], window) for picture in (rgb, wanted))
            terms["lpips"] = perceptual(shown, wanted)
        return terms

    def configure_optimizers(self) -> torch.optim.Adam:
        """Returns Adam of all parameters, whose steps of colours are shortened where `colour_shares` says so."""
        adam = super().configure_optimizers()
        if self._colour_shares is not None:
            shares, gaussians, kept = self._colour_shares, self.avatar.gaussians, list[Tensor]()

            def keep(*_: Any) -> None:
                kept[:] = [colours.detach().clone() for colours in (gaussians.sh0, gaussians.sh_rest)]

            @torch.no_grad()
            def shorten(*_: Any) -> None:
                share = shares[gaussians.vertex_index][:, None, None]
                for colours, before in zip((gaussians.sh0, gaussians.sh_rest), kept, strict=True):
                    colours.copy_(before.lerp_(colours, share))

            adam.register_step_pre_hook(keep)
            adam.register_step_post_hook(shorten)
        return adam
