"""What the stages that train an avatar share: the rendered crop, optimiser, schedules, densification, guards."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from occfusion.geometry.boxes import person_box
from occfusion.gpu import graphs
from occfusion.human.avatar import Avatar
from occfusion.human.avatar_file import describe_avatar
from occfusion.human.densify import Densifier
from occfusion.human.gaussians import means_rate
from occfusion.human.rendering import Renderer
from occfusion.perceptual import PerceptualMetric, random_crop_box
from occfusion.quality import losses
from occfusion.settings.stages import AvatarSettings
from occfusion.stages.base import Stage, check_finite_gradients, check_finite_terms
from occfusion.stages.surface import SurfacePrior
from occfusion.types import Box, Camera, Frame, Rendering

BOX_PADDING = 8
"""Pixels added around the person's box: the widest usual splat at its rim."""
VERTEX_REFRESH = 100
"""Steps between looking up each Gaussian's nearest body vertex anew."""
ADAM_EPS = 1e-15
"""As 3DGS: gradients of the mean over many pixels are tiny, and a larger floor would slow them down."""


class AvatarStage(Stage):
    """An interface: a stage that trains an avatar; a stage of its own gives the loss terms.

    Args:
        avatar: the avatar to train, in place.
        settings: schedules and rates.
        perceptual: the perceptual metric; None exactly when its term has no weight.
        densifier: densification; None exactly when `settings.densify` is false.
        renderer: draws the avatar.
        seed: decides the perceptual crops, step by step.
        steps_before: of earlier stages: rates and SH bands follow the count of all steps, densification its own.
        surface: what closes the surface where the video does not tell; None: nothing does.
    """

    def __init__(
        self,
        avatar: Avatar,
        settings: AvatarSettings,
        *,
        perceptual: PerceptualMetric | None,
        densifier: Densifier | None,
        renderer: Renderer,
        seed: int,
        steps_before: int = 0,
        surface: SurfacePrior | None = None,
    ) -> None:
        super().__init__()
        self.avatar = avatar
        self._schedule = settings
        # wrapped in a tuple so that the frozen network is not part of this module's state
        self._perceptual = (perceptual,)
        self.densifier = densifier
        self._renderer = renderer
        self.seed = seed
        self.steps_before = steps_before
        self.surface = surface
        self._screen_offsets: Tensor | None = None
        self._radii: Tensor | None = None
        self._camera: Camera | None = None

    @abstractmethod
    def terms(self, frame: Frame, rendering: Rendering, box: Box) -> Mapping[str, Tensor]:
        """Returns the loss terms of this step, unweighted; those of weight zero are not built.

        Args:
            frame: of this step.
            rendering: the avatar in its pose, inside `box`.
            box: the rendered window.
        """

    def weight(self, name: str) -> float:
        """Returns the weight of a term; every k-th step at k times the weight leaves the expected gradient as it is."""
        if self.surface is not None and name.startswith("surface_"):
            return self._schedule.lambda_rgb * self.surface.weight(name)
        weight = self._schedule.term_weights()[name]
        return weight * self._schedule.perceptual_every if name == "lpips" else weight

    @property
    def num_gaussians(self) -> int:
        """Gaussians at present."""
        return self.avatar.gaussians.num_gaussians

    def progress_note(self) -> str:
        """Returns the number of Gaussians."""
        return f"{self.num_gaussians / 1000:.1f}k gaussians"

    def counts(self) -> dict[str, int]:
        """Returns the number of Gaussians."""
        return {"gaussians": self.num_gaussians}

    def colour_terms(
        self, rgb: Tensor, target: Tensor, mask: Tensor, structure: tuple[Tensor, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """Returns `rgb` over the pixels of a mask and `ssim` within it; those of weight zero are not built.

        The structural term stays off the mask's edge, where masks are a pixel off and pictures show half background.

        Args:
            rgb: the rendered crop, `[h, w, 3]`.
            target: the frame's.
            mask: bool `[h, w]`.
            structure: target and mask of the structural term, where they are others.
        """
        weights, margin = self._schedule.term_weights(), self._schedule.ssim_margin
        if structure is None and weights["rgb"] and weights["ssim"]:
            compiled = self._renderer.backend == "numba"
            both = losses.l1_and_ssim(rgb, target, mask, margin, compiled=compiled)
            return dict(zip(("rgb", "ssim"), both, strict=True))
        terms = {"rgb": losses.l1(rgb, target, mask)} if weights["rgb"] else {}
        if weights["ssim"]:
            shown, looked_at = (target, mask) if structure is None else structure
            terms["ssim"] = losses.masked_ssim_loss(rgb, shown, losses.within(looked_at, margin))
        return terms

    # -- one step ---------------------------------------------------------------------------------------------

    def training_step(self, frame: Frame, _batch_idx: int) -> Tensor:
        """Returns the weighted sum of the loss terms for one frame."""
        self.frame = frame
        rendering, box = self._render_crop(frame)
        terms = self.terms(frame, rendering, box)
        if self.surface is not None:
            terms = {**terms, **self.surface.terms(self.avatar, self.global_step)}
        weighted = [self.weight(name) * value for name, value in terms.items()]
        # a frame may have no term at all; backward can be called of this
        total = sum(weighted[1:], start=weighted[0]) if weighted else 0.0 * rendering.alpha.sum()
        check_finite_terms(terms, self.name, self.global_step, frame.name, total)
        self.keep_terms(terms, total)
        return total

    def _render_crop(self, frame: Frame) -> tuple[Rendering, Box]:
        camera = frame.camera
        cloud = self.avatar(frame.pose, camera.centre)
        shown = frame.visible_mask if frame.complete_mask is None else frame.complete_mask
        compiled = self._renderer.backend == "numba"
        box = person_box(cloud.means.detach(), shown, camera, BOX_PADDING, compiled=compiled)
        if self.densifier is not None:
            self._screen_offsets = torch.zeros_like(cloud.means[:, :2], requires_grad=True)
        rendering = self._renderer.draw(cloud, camera, crop=box, screen_offsets=self._screen_offsets)
        self._radii, self._camera = rendering.radii, camera
        return rendering, box

    def perceptual_due(self) -> PerceptualMetric | None:
        """Returns the perceptual metric at the steps that have its term."""
        settings = self._schedule
        if self.global_step < settings.first_perceptual_step or self.global_step % settings.perceptual_every:
            return None
        return self._perceptual[0]

    def perceptual_box(self, mask: Tensor) -> Box:
        """Returns this step's random crop about a mask, in the coordinates of the mask."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.global_step)
        side = self._schedule.perceptual_crop
        return random_crop_box(mask, max(mask.shape) if side is None else side, generator)

    # -- optimiser, schedules, densification ------------------------------------------------------------------

    def configure_optimizers(self) -> torch.optim.Adam:
        """Returns Adam with one named group for each kind of parameter, its moments fresh.

        Fresh also where a stage takes an avatar over: the moments of a loss of another scale would stall it.
        """
        groups = self.avatar.parameter_groups(vars(self._schedule.rates))
        for group in groups:
            group["first_lr"] = group["lr"]
        adam = torch.optim.Adam(groups, eps=ADAM_EPS, fused=True)
        adam.register_step_post_hook(_count_change)
        return adam

    def on_train_start(self) -> None:
        """Begins with no values of the skinning network from the stage before; starts the training clock."""
        if self.global_step == 0:  # an avatar from a file has none either
            self.avatar.forget_skinning()
        # beside gsplat a recorded step has trained wrongly, for a reason that is not known (docs/experiments/060)
        graphs.record(self._renderer.backend == "torch")
        super().on_train_start()

    def on_train_end(self) -> None:
        """Stops the training clock; forgets what a GPU recorded of its steps."""
        super().on_train_end()
        graphs.record(False)

    def on_train_batch_start(self, _batch: Any, _batch_idx: int) -> None:
        """Densifies when it is time, then sets what follows the step: rates, SH bands, the skinning network's turn.

        Densification belongs to the start of a step: a checkpoint is written at the end of one, before any hook of
        this module could run, and a resumed run must not miss a round.
        """
        step, settings = self.steps_before + self.global_step, self._schedule
        if self.densifier is not None:
            self.densifier.step(self.global_step, self.avatar, self._adam(), seed=self.seed)
        if step % VERTEX_REFRESH == 0 and step > 0:
            self.avatar.refresh_vertex_index()
        degree = min(settings.sh_degree, step // settings.sh_every)
        self.avatar.active_sh_degree = max(self.avatar.active_sh_degree, degree)
        self.avatar.prepare(step)
        if self.surface is not None:
            self.surface.hold(self.avatar)
        decay = settings.rates_at_end ** (self.global_step / settings.steps)
        rate_of_means = means_rate(step, settings.rates.means, settings.rates.means_final)
        for group in self._adam().param_groups:
            group["lr"] = decay * (rate_of_means if group["name"] == "means" else group["first_lr"])

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Checks the gradients and collects what densification needs of them."""
        name = "" if self.frame is None else self.frame.name
        check_finite_gradients(optimizer.param_groups, self.name, self.global_step, name)
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
        """Adds the training seconds, and what the avatar's tensors do not say, for whoever looks at it meanwhile."""
        super().on_save_checkpoint(checkpoint)
        checkpoint["avatar"] = describe_avatar(self.avatar)


def _count_change(optimizer: torch.optim.Optimizer, *_: Any) -> None:
    """Says that parameters have changed: the fused step of torch 2.13 does not, and what is kept of them would stay."""
    increment_version([parameter for group in optimizer.param_groups for parameter in group["params"]])
