"""The settings of `prior=sd15` under `inpaint` (paper §4.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from occfusion.inpaint.side_by_side import HALVES
from occfusion.priors.region import MULTIPLE
from occfusion.priors.sd15_models import SAMPLERS
from occfusion.priors.sd15_settings import check_setting


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
