"""The optimisation stage: human Gaussians from what is seen, and from a prior (paper §4.2; §3.3 for `A`)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from occfusion import losses
from occfusion.geometry.boxes import crop, person_box
from occfusion.human.avatar import Avatar
from occfusion.human.densify import Densifier
from occfusion.human.gaussians import means_rate
from occfusion.perceptual import PerceptualMetric, random_crop_box
from occfusion.splat import rasterize
from occfusion.stages.base import AvatarStage, check_finite_gradients, check_finite_terms
from occfusion.stages.distil import Distiller
from occfusion.stages.settings import OptimSettings
from occfusion.stages.targets import Target, crop_frame
from occfusion.types import Box, Camera, Frame, Rendering

BOX_PADDING = 8
"""Pixels added around the person's box: the widest usual splat at its rim."""
VERTEX_REFRESH = 100
"""Steps between looking up each Gaussian's nearest body vertex anew."""
ADAM_EPS = 1e-15
"""As 3DGS: gradients of the mean over many pixels are tiny, and a larger floor would slow them down."""


class OptimStage(AvatarStage):
    """Fits the avatar to the visible pixels and the masks.

    Terms of weight zero are not built: without `lambda_lpips` no network is loaded, and none is asked for here.

    Args:
        avatar: the avatar to train, in place.
        settings: weights, schedules and rates.
        perceptual: the perceptual metric; None exactly when `settings.lambda_lpips` is 0.
        densifier: densification; None exactly when `settings.densify` is false.
        distiller: score distillation; None where none of its terms has a weight.
        backend: rasteriser backend.
        seed: decides the perceptual crops, step by step.
    """

    name = "optim"

    def __init__(
        self,
        avatar: Avatar,
        settings: OptimSettings,
        *,
        perceptual: PerceptualMetric | None,
        densifier: Densifier | None,
        distiller: Distiller[Any] | None = None,
        backend: str,
        seed: int,
    ) -> None:
        super().__init__()
        self.avatar = avatar
        self.settings = settings
        # wrapped in a tuple so that the frozen network is not part of this module's state
        self._perceptual = (perceptual,)
        self.densifier = densifier
        self.distiller = distiller
        self.backend = backend
        self.seed = seed
        self._frame_name = ""
        self._screen_offsets: Tensor | None = None
        self._radii: Tensor | None = None
        self._camera: Camera | None = None

    @property
    def num_gaussians(self) -> int:
        """Gaussians at present."""
        return self.avatar.gaussians.num_gaussians

    # -- one step ---------------------------------------------------------------------------------------------

    def training_step(self, frame: Frame, _batch_idx: int) -> Tensor:
        """Returns the weighted sum of the loss terms for one frame (paper §4.2, eq. of the stage's gradient)."""
        self._frame_name = frame.name
        step = self.global_step
        rendering, target, box = self._render_crop(frame)
        terms = self._terms_of(rendering, target, step)
        if self.distiller is not None:
            terms |= self.distiller.terms(self.avatar, frame, rendering.alpha, box, step)
        self.keep_terms(terms)
        check_finite_terms(terms, self.name, step, frame.name)
        return sum((self._weight(name) * value for name, value in terms.items()), start=torch.zeros(()))

    def _render_crop(self, frame: Frame) -> tuple[Rendering, Target, Box]:
        camera = frame.camera
        cloud = self.avatar(frame.pose, camera.centre)
        shown = frame.visible_mask if frame.complete_mask is None else frame.complete_mask
        box = person_box(cloud.means.detach(), shown, camera, BOX_PADDING)
        if self.densifier is not None:
            self._screen_offsets = torch.zeros_like(cloud.means[:, :2], requires_grad=True)
        rendering = rasterize(
            cloud.means, None, None, cloud.opacities, cloud.colors, camera.viewmat, camera.K,
            camera.width, camera.height, covariances=cloud.covariances, backend=self.backend,
            crop=box, screen_offsets=self._screen_offsets,
        )  # fmt: skip
        self._radii, self._camera = rendering.radii, camera
        return rendering, crop_frame(frame, box), box

    def _terms_of(self, rendering: Rendering, target: Target, step: int) -> dict[str, Tensor]:
        settings = self.settings
        everywhere = settings.pixels == "all"
        pixels = torch.ones_like(target.visible_mask) if everywhere else target.visible_mask
        rgb = rendering.rgb if everywhere else rendering.rgb * pixels[..., None]
        terms: dict[str, Tensor] = {}
        if settings.lambda_rgb:
            terms["rgb"] = losses.l1(rgb, target.rgb, pixels)
        if settings.lambda_mask:
            terms["mask"] = losses.l2(rendering.alpha, target.mask.to(rgb.dtype))
        if settings.lambda_ssim:
            terms["ssim"] = losses.ssim_loss(rgb, target.rgb, pixels)
        perceptual = self._perceptual[0]
        if perceptual is not None and step % settings.perceptual_every == 0:
            # outside the visible pixels both pictures are black
            box = self._perceptual_box(target.visible_mask, step)
            terms["lpips"] = perceptual(crop(rgb, box), crop(target.rgb, box))
        return terms

    def _weight(self, name: str) -> float:
        if self.distiller is not None and name.startswith("sds_"):
            return self.distiller.weight(name)
        weight: float = getattr(self.settings, f"lambda_{name}")
        # every k-th step at k times the weight leaves the expected gradient as it is
        return weight * self.settings.perceptual_every if name == "lpips" else weight

    def _perceptual_box(self, mask: Tensor, step: int) -> Box:
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + step)
        return random_crop_box(mask, self.settings.perceptual_crop, generator)

    # -- optimiser, schedules, densification ------------------------------------------------------------------

    def configure_optimizers(self) -> torch.optim.Adam:
        """Returns Adam with one named group for each kind of parameter."""
        groups = self.avatar.parameter_groups(vars(self.settings.rates))
        return torch.optim.Adam(groups, eps=ADAM_EPS, fused=False)

    def on_train_start(self) -> None:
        """Starts the training clock."""
        self.clock.start()

    def on_train_end(self) -> None:
        """Stops the training clock."""
        self.clock.stop()

    def on_train_batch_start(self, _batch: Any, _batch_idx: int) -> None:
        """Densifies when it is time, then sets what follows the step: rates, SH bands, the skinning network's turn.

        Densification belongs to the start of a step: a checkpoint is written at the end of one, before any hook of
        this module could run, and a resumed run must not miss a round.
        """
        step, settings = self.global_step, self.settings
        if self.densifier is not None:
            self.densifier.step(step, self.avatar, self._adam(), seed=self.seed)
        if step % VERTEX_REFRESH == 0 and step > 0:
            self.avatar.refresh_vertex_index()
        self.avatar.active_sh_degree = min(settings.sh_degree, step // settings.sh_every)
        self.avatar.prepare(step)
        for group in self._adam().param_groups:
            if group["name"] == "means":
                group["lr"] = means_rate(step, settings.rates.means, settings.rates.means_final)

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Checks the gradients and collects what densification needs of them."""
        check_finite_gradients(optimizer.param_groups, self.name, self.global_step, self._frame_name)
        if self.densifier is not None and self._screen_offsets is not None:
            gradient = self._screen_offsets.grad
            assert gradient is not None and self._radii is not None and self._camera is not None
            self.densifier.observe(gradient, self._radii, self._camera)

    def _adam(self) -> torch.optim.Adam:
        optimizer = self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizer, torch.optim.Adam)
        return optimizer

    # -- resuming ---------------------------------------------------------------------------------------------

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds the training seconds."""
        checkpoint["train_seconds"] = self.clock.seconds

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Takes the training seconds of the earlier run over."""
        self.clock.restore(checkpoint["train_seconds"])
