"""In-context inpainting with Stable Diffusion: a hidden person beside its complete rendering (paper §4.3)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from occfusion.fields import check_fields, setting
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
from occfusion.priors.sd15.settings import Sd15Settings

PROMPT = "the same person standing in two different rooms"


@dataclass(frozen=True)
class Sd15InpaintSettings:
    """How appearance is inpainted, the paper's values; models, memory, margin and seed are the mask prior's settings.

    Raises:
        ConfigError: a value is not allowed.
    """

    prompt: str | None = setting(None, f"what the two halves shall show; null: the paper's, `{PROMPT}`")
    negative_prompt: str | None = setting(
        None, "what they shall not show; null: what the mask prior's picture shall not, as in the paper"
    )
    steps: int = setting(10, "evaluations for each picture", 1)
    guidance: float = setting(7.5, "weight of the prompts (classifier-free guidance)", 0)
    control_scale: float = setting(0.3, "weight of the ControlNet", 0)
    guess_mode: bool = setting(
        True,
        "whether the skeleton is told to the prompted branch of the guidance only, its coarse levels less",
    )
    sampler: str = setting(
        "unipc",
        "of the diffusion; model: the one that the model's folder names",
        choices=(*SAMPLERS, "model"),
    )
    resolution: int = setting(
        512,
        "longer side of the two halves together, pixels; 0: each as large as the region is in the picture",
        0,
        multiple=HALVES * MULTIPLE,
    )

    def __post_init__(self) -> None:
        check_fields(self, "prior.inpaint")
        if self.prompt is None:
            object.__setattr__(self, "prompt", PROMPT)


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
        own, shared = self.settings.negative_prompt, self.shared.negative_prompt
        assert shared is not None  # filled in
        return shared if own is None else own

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
