"""In-context inpainting with Stable Diffusion: a hidden person beside its complete rendering (paper §4.3)."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from occfusion.inpaint.partial import Inpainter, Partial, Picture
from occfusion.inpaint.side_by_side import (
    HALVES,
    SideBySide,
    draw_side_by_side,
    put_back,
    put_side_by_side,
    right_half,
)
from occfusion.observation.frames import Observation
from occfusion.priors.sd15.loading import SAMPLERS
from occfusion.priors.sd15.pipeline import (
    as_planes,
    find_inpainting,
    frame_seed,
    inpainting_hashes,
    make_pipeline,
    resolve_placement,
)
from occfusion.priors.sd15.region import MULTIPLE, Region, body_keypoints, body_region
from occfusion.priors.sd15.settings import Sd15Settings, check_setting


@dataclass(frozen=True)
class Sd15InpaintSettings:
    """How appearance is inpainted, the paper's values; models, memory, margin and seed are the mask prior's settings.

    Attributes:
        prompt: what the two halves shall show.
        negative_prompt: what they shall not show; null: what the mask prior's picture shall not.
        steps: evaluations for each picture.
        guidance: weight of the prompts (classifier-free guidance).
        control_scale: weight of the ControlNet.
        guess_mode: whether the skeleton is told to the prompted branch of the guidance only, its coarse levels less.
        sampler: dpmsolver++, unipc, ddim, or model for the one that the model's folder names.
        resolution: longer side of the two halves together, pixels, a multiple of 16; 0: each as large as the
            region is in the picture.

    Raises:
        ConfigError: a value is not allowed.
    """

    prompt: str = "the same person standing in two different rooms"
    negative_prompt: str | None = None
    steps: int = 10
    guidance: float = 7.5
    control_scale: float = 0.3
    guess_mode: bool = True
    sampler: str = "unipc"
    resolution: int = 512

    def __post_init__(self) -> None:
        _check("prompt", self.prompt, isinstance(self.prompt, str), "a text")
        is_text = self.negative_prompt is None or isinstance(self.negative_prompt, str)
        _check("negative_prompt", self.negative_prompt, is_text, "a text; null: the mask prior's")
        _check("steps", self.steps, self.steps >= 1, "at least 1")
        for key in ("guidance", "control_scale"):
            value = getattr(self, key)
            _check(key, value, 0.0 <= value < math.inf, "0 or more")
        _check("sampler", self.sampler, self.sampler in (*SAMPLERS, "model"), f"{', '.join(SAMPLERS)}, model")
        multiple = HALVES * MULTIPLE
        allowed = self.resolution >= 0 and self.resolution % multiple == 0
        _check("resolution", self.resolution, allowed, f"a multiple of {multiple}; 0: as the picture is")


def _check(key: str, value: object, holds: bool, allowed: str) -> None:
    check_setting(f"inpaint.{key}", value, holds, allowed)


class Sd15Inpainter(Inpainter):
    """Paints the hidden part of a frame with the coarse rendering of the same frame to its left.

    Args:
        settings: prompts, sampling, resolution.
        shared: the mask prior's settings, of which it takes the models, where and how they run, the margin, the
            limit of self-occlusion, the seed and, where it has none itself, the negative prompt.
        device: where the models run, unless the settings say it.

    Raises:
        ConfigError: a package is missing, or a setting is wrong.
        DataError: a model is missing or incomplete.
    """

    name = "sd15"

    def __init__(
        self, settings: Sd15InpaintSettings, shared: Sd15Settings, device: torch.device | str = "cpu"
    ) -> None:
        self.settings, self.shared = settings, shared
        self.device, self.dtype = resolve_placement(shared, device)
        self._folders = find_inpainting(shared)
        self.hashes = inpainting_hashes(self._folders)

    @cached_property
    def pipeline(self) -> Any:
        """The models, loaded when the first frame is painted: where nothing is hidden they are not needed.

        Raises:
            DataError: the files do not belong together or are damaged.
        """
        return make_pipeline(self._folders, self.shared, self.settings.sampler, self.device, self.dtype)

    @property
    def negative_prompt(self) -> str:
        """What the picture shall not show."""
        own = self.settings.negative_prompt
        return self.shared.negative_prompt if own is None else own

    def describe(self) -> dict[str, Any]:
        """Returns what decides the pictures: prompts, sampling, precision, and the hashes of the models."""
        taken = {key: getattr(self.shared, key) for key in ("margin", "self_occlusion", "seed")}
        return {
            "inpainter": self.name,
            **asdict(self.settings),
            **taken,
            "negative_prompt": self.negative_prompt,
            "dtype": self.dtype,
            **self.hashes,
        }

    def inpaint(self, partial: Partial) -> Picture:
        """Returns the complete person over black, `[H, W, 3]`; what the models made not finite is NaN in the region.

        Raises:
            DataError: the models do not load.
        """
        region = self.region(partial.observation)
        if region is None:
            return put_back(None, partial, None)
        given = put_side_by_side(partial, region)
        if not given.mask.any():
            return put_back(None, partial, region)
        painted = self.paint(given, partial.observation, region)
        if not np.isfinite(painted).all():
            painted = np.full_like(painted, np.nan)
        return put_back(right_half(painted), partial, region)

    def region(self, observation: Observation) -> Region | None:
        """Returns what becomes a half of the canvas; None where the body is outside the picture."""
        found = body_region(observation, self.shared.margin)
        return None if found is None else found.at_work(self.settings.resolution, HALVES)

    @torch.no_grad()
    def paint(self, given: SideBySide, observation: Observation, region: Region) -> Picture:
        """Returns both halves as the models make them, `[h, 2 w, 3]`, 0..1."""
        settings = self.settings
        seen = body_keypoints(observation, region, self.shared.self_occlusion)
        canvas = draw_side_by_side(seen, region).astype(np.float32) / 255.0
        result = self.pipeline(
            prompt=settings.prompt, negative_prompt=self.negative_prompt, image=as_planes(given.picture),
            mask_image=as_planes(given.mask[..., None].astype(np.float32)), control_image=as_planes(canvas),
            width=HALVES * region.work_width, height=region.work_height, num_inference_steps=settings.steps,
            guidance_scale=settings.guidance, controlnet_conditioning_scale=settings.control_scale,
            guess_mode=settings.guess_mode,
            generator=torch.Generator().manual_seed(frame_seed(self.shared.seed, observation.name)),
            output_type="np",
        )  # fmt: skip
        return np.asarray(result.images[0], np.float32)
