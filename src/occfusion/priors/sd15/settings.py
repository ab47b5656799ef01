"""The settings of `prior=sd15`: models, prompts and sampling (paper §4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from occfusion.errors import ConfigError
from occfusion.observation.keypoints import SELF_OCCLUSION
from occfusion.priors.sd15.loading import SAMPLERS
from occfusion.priors.sd15.region import MULTIPLE

DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
NO_EFFECT = (
    "inpainting", "controlnet", "segmenter", "inpainting_revision", "controlnet_revision", "segmenter_revision",
    "local_files_only", "device", "attention_slicing", "vae_slicing", "cpu_offload",
)  # fmt: skip
"""Settings that leave the masks as they are; of the models, hashes are recorded instead."""


@dataclass(frozen=True)
class Sd15Settings:
    """Settings of `prior=sd15`; the paper's values.

    Attributes:
        inpainting: id or folder of the inpainting model.
        controlnet: id or folder of the ControlNet for OpenPose canvases.
        segmenter: id or folder of SAM-HQ.
        inpainting_revision: branch, tag or commit; null: the newest. Of an id only.
        controlnet_revision: the same for the ControlNet.
        segmenter_revision: the same for SAM-HQ.
        local_files_only: whether nothing is downloaded.
        prompt: what the picture shall show.
        negative_prompt: what it shall not show.
        steps: evaluations for each picture.
        guidance: weight of the prompts (classifier-free guidance).
        control_scale: weight of the ControlNet.
        sampler: dpmsolver++, unipc, ddim, or model for the one that the model's folder names.
        margin: pixels around the body's box.
        resolution: longer side of the inpainted picture, pixels, a multiple of 8; 0: as the picture is.
        self_occlusion: the paper's sigma, metres.
        seed: of the noise; each frame has its own, made of this and its name.
        dtype: float32, float16, bfloat16, or auto: float16 on a GPU, float32 on a CPU.
        device: a PyTorch device; null: the run's.
        attention_slicing: less memory, slower.
        vae_slicing: less memory where several pictures are decoded.
        cpu_offload: models are on the GPU only while they work; needs accelerate.
    """

    inpainting: str = "stable-diffusion-v1-5/stable-diffusion-inpainting"
    controlnet: str = "lllyasviel/sd-controlnet-openpose"
    segmenter: str = "syscv-community/sam-hq-vit-huge"
    inpainting_revision: str | None = None
    controlnet_revision: str | None = None
    segmenter_revision: str | None = None
    local_files_only: bool = True
    prompt: str = (
        "clean background, high contrast to background, a person only, plain clothes, simple clothes, natural body, "
        "natural limbs, no texts, no overlay"
    )
    negative_prompt: str = (
        "multiple objects, occlusions, complex pattern, fancy clothes, longbody, lowres, bad anatomy, bad hands, "
        "bad feet, missing fingers, cropped, worst quality, low quality, blurry"
    )
    steps: int = 10
    guidance: float = 7.5
    control_scale: float = 1.0
    sampler: str = "dpmsolver++"
    margin: int = 20
    resolution: int = 512
    self_occlusion: float = SELF_OCCLUSION
    seed: int = 0
    dtype: str = "auto"
    device: str | None = None
    attention_slicing: bool = False
    vae_slicing: bool = False
    cpu_offload: bool = False

    def __post_init__(self) -> None:
        check_setting("steps", self.steps, self.steps >= 1, "at least 1")
        check_setting("guidance", self.guidance, self.guidance >= 0.0, "0 or more")
        check_setting("control_scale", self.control_scale, self.control_scale >= 0.0, "0 or more")
        check_setting("margin", self.margin, self.margin >= 0, "0 or more")
        allowed = self.resolution >= 0 and self.resolution % MULTIPLE == 0
        check_setting(
            "resolution", self.resolution, allowed, f"a multiple of {MULTIPLE}; 0: as the picture is"
        )
        check_setting("self_occlusion", self.self_occlusion, self.self_occlusion >= 0.0, "0 or more")
        check_setting(
            "sampler", self.sampler, self.sampler in (*SAMPLERS, "model"), f"{', '.join(SAMPLERS)}, model"
        )
        check_setting("dtype", self.dtype, self.dtype in ("auto", *DTYPES), f"auto, {', '.join(DTYPES)}")


def check_setting(key: str, value: object, holds: bool, allowed: str) -> None:
    """Refuses a value.

    Args:
        key: of the setting, below `prior`.
        value: what was chosen.
        holds: whether it is allowed.
        allowed: what is, in words.

    Raises:
        ConfigError: `holds` is false.
    """
    if not holds:
        raise ConfigError(f"setting prior.{key}={value!r}: must be {allowed}")


def resolve_device(device: str | None, dtype: str, default: torch.device | str) -> torch.device:
    """Returns where models run.

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
    return found
