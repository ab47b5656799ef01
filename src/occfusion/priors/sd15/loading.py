"""Loads Stable Diffusion, ControlNet and SAM-HQ; the only module that imports diffusers and transformers."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from occfusion.errors import ConfigError, DataError
from occfusion.priors.sd15.model_folder import (
    CONTROLNET,
    INPAINTING,
    SCORE_CONTROLNET,
    SCORE_MODEL,
    SEGMENTER,
    ModelKind,
    variant_of,
)

SAMPLERS = {
    "dpmsolver++": "DPMSolverMultistepScheduler",
    "unipc": "UniPCMultistepScheduler",
    "ddim": "DDIMScheduler",
}
"""Samplers by the name of the setting `prior.sampler`."""

INSTALL = 'pip install "occfusion[sd15]"'


def require_packages(cpu_offload: bool) -> None:
    """Checks that what `prior=sd15` needs is installed.

    Raises:
        ConfigError: a package is missing; names it and the command that installs it.
    """
    needed = ["diffusers", "transformers", *(["accelerate"] if cpu_offload else [])]
    missing = [name for name in needed if importlib.util.find_spec(name) is None]
    if missing:
        why = " (prior.cpu_offload=true)" if missing == ["accelerate"] else ""
        raise ConfigError(
            f"prior=sd15 needs {' and '.join(missing)}{why}, which the plain installation leaves out: {INSTALL} "
            f'(in a copy of the source: pip install -e ".[sd15]"); prior=embedded needs nothing more'
        )


def load_inpainting(inpainting: Path, controlnet: Path, sampler: str, dtype: torch.dtype) -> Any:
    """Returns a `StableDiffusionControlNetInpaintPipeline` on the CPU, in `dtype`.

    Raises:
        DataError: the files do not belong together or are damaged.
    """
    import diffusers
    import transformers

    with _quiet():
        parts = {"controlnet": _load(diffusers.ControlNetModel, CONTROLNET, controlnet, dtype)}
        for name, library, kind in (
            ("unet", diffusers, "UNet2DConditionModel"),
            ("vae", diffusers, "AutoencoderKL"),
            ("text_encoder", transformers, "CLIPTextModel"),
        ):
            parts[name] = _load(getattr(library, kind), INPAINTING, inpainting, dtype, subfolder=name)
        with _explained(INPAINTING.setting, inpainting):
            # the safety checker paints pictures that it doubts black, which here would become an empty mask
            pipeline = diffusers.StableDiffusionControlNetInpaintPipeline.from_pretrained(
                inpainting, safety_checker=None, feature_extractor=None, image_encoder=None,
                requires_safety_checker=False, use_safetensors=True, local_files_only=True, **parts,
            )  # fmt: skip
            if sampler != "model":
                scheduler = getattr(diffusers, SAMPLERS[sampler])
                pipeline.scheduler = scheduler.from_config(pipeline.scheduler.config)
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def load_segmenter(folder: Path, dtype: torch.dtype) -> tuple[Any, Any]:
    """Returns a `SamHQModel` on the CPU, in `dtype`, and its `SamHQProcessor`.

    Raises:
        DataError: the files do not belong together or are damaged.
    """
    import transformers

    with _quiet():
        model = _load(transformers.SamHQModel, SEGMENTER, folder, dtype)
        with _explained(SEGMENTER.setting, folder):
            processor = transformers.SamHQProcessor.from_pretrained(folder, local_files_only=True)
    return model, processor


@dataclass(frozen=True)
class Denoiser:
    """Stable Diffusion in parts.

    Attributes:
        unet: predicts noise in latents of 4 channels.
        controlnet: steers it by a canvas.
        vae: makes latents of pictures, float32.
        texts: embeddings of the prompts, `[1, 77, C]` each.
        kept: alpha-bar of each step of its schedule, `[T]`, float64.
    """

    unet: Any
    controlnet: Any
    vae: Any
    texts: tuple[torch.Tensor, ...]
    kept: torch.Tensor


@torch.no_grad()
def load_denoiser(model: Path, controlnet: Path, dtype: torch.dtype, prompts: tuple[str, ...]) -> Denoiser:
    """Returns Stable Diffusion on the CPU, frozen, with prompts embedded; its text encoder is let go.

    Args:
        model: folder of the pipeline.
        controlnet: folder of the ControlNet.
        dtype: of UNet and ControlNet.
        prompts: what to embed.

    Raises:
        DataError: the files do not belong together, are damaged, or are those of an inpainting model.
    """
    import diffusers
    import transformers

    with _quiet():
        control = _load(diffusers.ControlNetModel, SCORE_CONTROLNET, controlnet, dtype)
        unet = _load(diffusers.UNet2DConditionModel, SCORE_MODEL, model, dtype, "unet")
        vae = _load(diffusers.AutoencoderKL, SCORE_MODEL, model, torch.float32, "vae")
        encoder = _load(transformers.CLIPTextModel, SCORE_MODEL, model, torch.float32, "text_encoder")
        with _explained(SCORE_MODEL.setting, model):
            if unet.config.in_channels != 4:
                raise ValueError(
                    f"its UNet takes {unet.config.in_channels} channels, not 4: it is for inpainting"
                )
            tokenizer = transformers.CLIPTokenizer.from_pretrained(
                model, subfolder="tokenizer", local_files_only=True
            )
            schedule = diffusers.DDPMScheduler.from_pretrained(
                model, subfolder="scheduler", local_files_only=True
            )
            if schedule.config.prediction_type != "epsilon":
                raise ValueError(f"it predicts {schedule.config.prediction_type}, not the noise")
            options = {"padding": "max_length", "truncation": True, "return_tensors": "pt"}
            options["max_length"] = tokenizer.model_max_length
            texts = tuple(encoder(tokenizer(prompt, **options).input_ids)[0].to(dtype) for prompt in prompts)
    for part in (unet, control, vae):
        part.requires_grad_(False)
    return Denoiser(unet, control, vae, texts, schedule.alphas_cumprod.double())


def _load(kind: Any, model: ModelKind, folder: Path, dtype: torch.dtype, subfolder: str = "") -> Any:
    """Returns a network of a class of either library; both would fill in what the files lack with noise."""
    with _explained(model.setting, folder / subfolder):
        network, report = kind.from_pretrained(
            folder, subfolder=subfolder, dtype=dtype, variant=variant_of(model, folder), use_safetensors=True,
            local_files_only=True, output_loading_info=True,
        )  # fmt: skip
        lacking = [*report["missing_keys"], *report["mismatched_keys"]]
        if lacking:
            raise ValueError(
                f"its weights lack {len(lacking)} tensors of a {kind.__name__}, first {lacking[0]}"
            )
    return network.eval()


@contextmanager
def _explained(setting: str, folder: Path) -> Iterator[None]:
    """Turns whatever the loaders raise on wrong files into an error that names them."""
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, ArithmeticError, AttributeError) as error:
        line = (str(error).strip().splitlines() or [""])[0]
        raise DataError(
            f"{setting}: the model in {folder} does not load ({type(error).__name__}: {line}); download it again, "
            f"or choose a model of the same kind"
        ) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps the loaders' progress bars and advice off the terminal; errors are raised all the same."""
    from diffusers.utils import logging as diffusers_logging
    from transformers.utils import logging as transformers_logging

    libraries = (diffusers_logging, transformers_logging)
    levels = [library.get_verbosity() for library in libraries]
    for library in libraries:
        library.set_verbosity(logging.ERROR)
        library.disable_progress_bar()
    try:
        yield
    finally:
        for library, level in zip(libraries, levels, strict=True):
            library.set_verbosity(level)
            library.enable_progress_bar()
