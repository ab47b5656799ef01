"""Score distillation in the optimisation stage: in the frame's pose, or in the canonical one (paper §4.2)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from occfusion.errors import NumericsError
from occfusion.geometry.resample import take_square
from occfusion.human.avatar import Avatar
from occfusion.human.body import Body
from occfusion.human.rendering import Renderer
from occfusion.observation.crop import CANONICAL_ANGLES, PersonView, Square, view_canonical, view_observation
from occfusion.observation.frames import ObservedFrames
from occfusion.priors.distillation import time_at
from occfusion.priors.score import Draw, ScorePrior, distil
from occfusion.settings.stages import SdsSettings
from occfusion.types import Box, Camera, Frame

T = TypeVar("T")

KEPT_VIEWS = 128
"""Views whose conditions are remembered: 290 kB each with the embedded prior."""


@dataclass(frozen=True)
class _Prepared(Generic[T]):
    """A view as the prior is conditioned on it.

    Attributes:
        conditions: of `ScorePrior.encode_conditions`.
        mask: pixels that are pushed, `[S, S]`, 0 or 1.
        pushed: whether there is any.
        square: the crop in the frame; the whole picture of `camera` for a canonical view.
        camera: whose picture is the crop.
    """

    conditions: T
    mask: Tensor
    pushed: bool
    square: Square
    camera: Camera


class Distiller(Generic[T]):
    """Makes the distillation term of a step; what chance decides is a function of seed and step.

    Args:
        prior: whose score is distilled.
        settings: weights, times, and where; a branch of weight zero is never computed.
        steps: of the stage, for the annealed schedule.
        observed_frames: of all training frames.
        body: of the data set.
        renderer: draws the avatar.
        seed: of the choices.
    """

    def __init__(
        self,
        prior: ScorePrior[T],
        settings: SdsSettings,
        *,
        steps: int,
        observed_frames: ObservedFrames,
        body: Body,
        renderer: Renderer,
        seed: int,
    ) -> None:
        self.prior = prior
        self.settings = settings
        self.steps = steps
        self.body = body
        self._renderer = renderer
        self.seed = seed
        self._observed_frames = observed_frames
        self._views: OrderedDict[Hashable, _Prepared[T]] = OrderedDict()

    def terms(self, avatar: Avatar, frame: Frame, alpha: Tensor, box: Box, step: int) -> dict[str, Tensor]:
        """Returns `sds_pose` or `sds_can`, unweighted, or nothing where this step pushes nothing.

        Args:
            avatar: in training.
            frame: of this step.
            alpha: its rendered occupancy inside `box`, `[h, w]`.
            box: the rendered window of the frame.
            step: of the stage.

        Raises:
            NumericsError: the score is not finite.
        """
        settings = self.settings
        if step % settings.every:
            return {}
        generator = torch.Generator().manual_seed(self.seed * 1_000_033 + step)
        is_posed = float(torch.rand((), generator=generator)) < settings.posed_probability
        name, weight = ("sds_pose", settings.lambda_pose) if is_posed else ("sds_can", settings.lambda_can)
        if not weight:
            return {}
        turn = int(torch.randint(CANONICAL_ANGLES, (), generator=generator))
        view = self._posed_view(frame) if is_posed else self._canonical_view(turn)
        if not view.pushed:
            return {}
        if is_posed:
            square, where = view.square, f"frame {frame.name}"
            seen = take_square(alpha, box, square.x, square.y, square.side, self.prior.size)
        else:
            where = f"canonical pose at {turn * 360 // CANONICAL_ANGLES} degrees"
            seen = self._renderer.canonical_alpha(avatar, view.camera)
        loss = self._distil(seen, view, self._draw(step, generator)).to(alpha)
        if not bool(torch.isfinite(loss)):
            raise NumericsError(
                f"stage optim, step {step}, {where}: the score of prior {self.prior.name} is not finite. The state "
                f"before this step is saved; with prior=sd15 try prior.dtype=float32"
            )
        return {name: loss}

    def weight(self, name: str) -> float:
        """Returns the weight of a term; every k-th step at k times the weight leaves the expected gradient as it is."""
        settings = self.settings
        return settings.every * (settings.lambda_pose if name == "sds_pose" else settings.lambda_can)

    def _draw(self, step: int, generator: torch.Generator) -> Draw:
        settings = self.settings
        share = float(torch.rand((), generator=generator))
        t = time_at(settings.schedule, step / self.steps, share, settings.t_min, settings.t_max)
        noise = torch.randn(1, *self.prior.signal_shape, generator=generator)
        return Draw(t, noise.to(self.prior.device))

    def _distil(self, occupancy: Tensor, view: _Prepared[T], draw: Draw) -> Tensor:
        settings = self.settings
        return distil(
            self.prior, occupancy.to(self.prior.device), view.mask, view.conditions, draw,
            weighting=settings.weighting, guidance=settings.guidance, reduction=settings.reduction,
        )  # fmt: skip

    # -- views, remembered ------------------------------------------------------------------------------------

    def _posed_view(self, frame: Frame) -> _Prepared[T]:
        def make() -> tuple[Square, PersonView]:
            observed_frame = self._observed_frames[self._observed_frames.positions[frame.index]]
            observation = observed_frame.observation(frame, self.body)
            return view_observation(observation, self.prior.size)

        return self._remembered(frame.index, make)

    def _canonical_view(self, turn: int) -> _Prepared[T]:
        size = self.prior.size
        return self._remembered(
            ("canonical", turn), lambda: (Square(0.0, 0.0, size), view_canonical(self.body, turn, size))
        )

    def _remembered(self, key: Hashable, make: Callable[[], tuple[Square, PersonView]]) -> _Prepared[T]:
        if key not in self._views:
            self._views[key] = self._prepare(*make())
            if len(self._views) > KEPT_VIEWS:
                self._views.popitem(last=False)
        self._views.move_to_end(key)
        return self._views[key]

    def _prepare(self, square: Square, view: PersonView) -> _Prepared[T]:
        everywhere = self.settings.where == "everywhere"
        mask = np.ones((view.size, view.size), np.float32) if everywhere else view.hidden
        shown = view if self.settings.evidence else replace(view, visible=None, background=None)
        camera = replace(view.camera, viewmat=view.camera.viewmat.float(), K=view.camera.K.float())
        device = self.prior.device
        return _Prepared(
            self.prior.encode_conditions(shown), torch.from_numpy(mask).to(device), bool(mask.any()), square,
            camera.to(device),
        )  # fmt: skip
