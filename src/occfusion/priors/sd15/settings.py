"""The settings of `prior=sd15`: models, prompts and sampling (paper §4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from occfusion.errors import ConfigError
from occfusion.fields import check_fields, setting
from occfusion.observation.keypoints import SELF_OCCLUSION
from occfusion.priors.sd15.loading import SAMPLERS
from occfusion.priors.sd15.region import MULTIPLE

DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
NO_EFFECT = (
    "inpainting", "controlnet", "segmenter", "inpainting_revision", "controlnet_revision", "segmenter_revision",
    "local_files_only", "device", "attention_slicing", "vae_slicing", "cpu_offload",
)  # fmt: skip
"""Settings that leave the masks as they are; of the models, hashes are recorded instead."""


PROMPT = (
    "clean background, high contrast to background, a person only, plain clothes, simple clothes, natural body, "
    "natural limbs, no texts, no overlay"
)
NEGATIVE_PROMPT = (
    "multiple objects, occlusions, complex pattern, fancy clothes, longbody, lowres, bad anatomy, bad hands, "
    "bad feet, missing fingers, cropped, worst quality, low quality, blurry"
)
SCORE_PROMPT = "the white silhouette of one whole person on black, all limbs, sharp outline"
SCORE_NEGATIVE_PROMPT = (
    "missing limbs, incomplete body, cropped, blurry, low quality, deformed, bad proportions"
)


@dataclass(frozen=True)
class Sd15Settings:
    """Settings of `prior=sd15`; the paper's values. A prompt of None becomes the one that the default names."""

    inpainting: str = setting(
        "stable-diffusion-v1-5/stable-diffusion-inpainting", "id or folder of the inpainting model"
    )
    controlnet: str = setting(
        "lllyasviel/sd-controlnet-openpose", "id or folder of the ControlNet for OpenPose canvases"
    )
    segmenter: str = setting("syscv-community/sam-hq-vit-huge", "id or folder of SAM-HQ")
    inpainting_revision: str | None = setting(
        None, "branch, tag or commit of the model; null: the newest; of an id only"
    )
    controlnet_revision: str | None = setting(None, "the same for the ControlNet")
    segmenter_revision: str | None = setting(None, "the same for SAM-HQ")
    local_files_only: bool = setting(True, "whether nothing is downloaded")
    prompt: str | None = setting(None, f"what the picture shall show; null: the paper's, `{PROMPT}`")
    negative_prompt: str | None = setting(
        None, f"what it shall not show; null: the paper's, `{NEGATIVE_PROMPT}`"
    )
    steps: int = setting(10, "evaluations for each picture", 1)
    guidance: float = setting(7.5, "weight of the prompts (classifier-free guidance)", 0)
    control_scale: float = setting(1.0, "weight of the ControlNet", 0)
    sampler: str = setting(
        "dpmsolver++",
        "of the diffusion; model: the one that the model's folder names",
        choices=(*SAMPLERS, "model"),
    )
    margin: int = setting(20, "pixels around the body's box", 0)
    resolution: int = setting(
        512, "longer side of the inpainted picture, pixels; 0: as the picture is", 0, multiple=MULTIPLE
    )
    self_occlusion: float = setting(SELF_OCCLUSION, "the paper's sigma, metres", 0)
    seed: int = setting(0, "of the noise; each frame has its own, made of this and its name", 0)
    dtype: str = setting(
        "auto", "of the networks; auto: float16 on a GPU, float32 on a CPU", choices=("auto", *DTYPES)
    )
    device: str | None = setting(None, "a PyTorch device; null: the run's")
    attention_slicing: bool = setting(False, "less memory, slower")
    vae_slicing: bool = setting(False, "less memory where several pictures are decoded")
    cpu_offload: bool = setting(False, "models are on the GPU only while they work; needs accelerate")

    def __post_init__(self) -> None:
        check_fields(self, "prior")
        fill_prompts(self, PROMPT, NEGATIVE_PROMPT)


@dataclass(frozen=True)
class Sd15ScoreModels:
    """Settings of `prior=sd15` under `score`. A prompt of None becomes the one that the default names."""

    model: str = setting(
        "stable-diffusion-v1-5/stable-diffusion-v1-5",
        "id or folder of Stable Diffusion 1.5, the one that is not for inpainting",
    )
    controlnet: str = setting(
        "lllyasviel/control_v11p_sd15_openpose", "id or folder of its ControlNet for OpenPose canvases"
    )
    model_revision: str | None = setting(
        None, "branch, tag or commit of the model; null: the newest; of an id only"
    )
    controlnet_revision: str | None = setting(None, "the same for the ControlNet")
    prompt: str | None = setting(None, f"the condition that guidance moves towards; null: `{SCORE_PROMPT}`")
    negative_prompt: str | None = setting(
        None,
        "what it starts from; with guidance 0, as the paper has it, the only one used; null: "
        f"`{SCORE_NEGATIVE_PROMPT}`",
    )
    control_scale: float = setting(1.0, "weight of the ControlNet", 0)

    def __post_init__(self) -> None:
        check_fields(self, "prior.score")
        fill_prompts(self, SCORE_PROMPT, SCORE_NEGATIVE_PROMPT)

    @property
    def prompts(self) -> tuple[str, str]:
        """Both prompts."""
        assert self.prompt is not None and self.negative_prompt is not None  # filled in
        return self.prompt, self.negative_prompt


@dataclass(frozen=True)
class Sd15ScoreSettings(Sd15ScoreModels):
    """The same, with what it shares with the mask prior; the VAE is in float32 whatever `dtype` is."""

    local_files_only: bool = True
    dtype: str = "auto"
    device: str | None = None


def fill_prompts(settings: Sd15Settings | Sd15ScoreModels, prompt: str, negative: str) -> None:
    """Puts the prompts that are meant in the place of those that are None."""
    for name, text in (("prompt", prompt), ("negative_prompt", negative)):
        if getattr(settings, name) is None:
            object.__setattr__(settings, name, text)


def resolve_device(device: str | None, dtype: str, default: torch.device | str) -> tuple[torch.device, str]:
    """Returns where models run and the name of their precision.

    Args:
        device: the setting `prior.device`.
        dtype: the setting `prior.dtype`.
        default: where they run if the setting is null.

    Raises:
        ConfigError: no such device, or half precision on a CPU.
    """
    try:
        found = torch.device(default if device is None else device)
    except RuntimeError as error:
        raise ConfigError(f"setting prior.device={device!r}: {str(error).splitlines()[0]}") from error
    if found.type == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"setting prior.device={device!r}: PyTorch finds no such GPU")
    if dtype == "float16" and found.type == "cpu":
        raise ConfigError("setting prior.dtype=float16 is for GPUs; on a CPU choose float32 or bfloat16")
    auto = "float32" if found.type == "cpu" else "float16"
    return found, auto if dtype == "auto" else dtype
