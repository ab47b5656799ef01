"""Stable Diffusion's inpainting under a skeleton, as masks (§4.1) and appearance (§4.3) both use it."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.errors import ConfigError
from occfusion.priors.sd15.loading import load_inpainting, require_packages
from occfusion.priors.sd15.model_folder import CONTROLNET, INPAINTING, find_model, fingerprint
from occfusion.priors.sd15.settings import DTYPES, Sd15Settings, resolve_device

Folders = tuple[Path, Path]
"""Of the inpainting model and of its ControlNet."""


def resolve_placement(settings: Sd15Settings, default: torch.device | str) -> tuple[torch.device, str]:
    """Returns where models run and the name of their precision.

    Args:
        settings: uses `device`, `dtype` and `cpu_offload`.
        default: where they run if the settings do not say it.

    Raises:
        ConfigError: no such device, or an option that it does not have.
    """
    device, dtype = resolve_device(settings.device, settings.dtype, default)
    if settings.cpu_offload and device.type == "cpu":
        raise ConfigError(
            "setting prior.cpu_offload=true: nothing runs on a GPU, so there is nothing to offload"
        )
    return device, dtype


def find_inpainting(settings: Sd15Settings) -> Folders:
    """Returns the folders of the inpainting model and its ControlNet, nothing loaded.

    Raises:
        ConfigError: a package is missing.
        DataError: a model is missing or incomplete; says what to download and how.
    """
    require_packages(settings.cpu_offload)
    only = settings.local_files_only
    return (
        find_model(INPAINTING, settings.inpainting, settings.inpainting_revision, only),
        find_model(CONTROLNET, settings.controlnet, settings.controlnet_revision, only),
    )


def inpainting_hashes(folders: Folders) -> dict[str, str]:
    """Returns the hashes of both models, for what is recorded of a prior."""
    return {
        "inpainting_hash": fingerprint(folders[0], INPAINTING),
        "controlnet_hash": fingerprint(folders[1], CONTROLNET),
    }


def make_pipeline(
    folders: Folders, settings: Sd15Settings, sampler: str, device: torch.device, dtype: str
) -> Any:
    """Returns a `StableDiffusionControlNetInpaintPipeline`, ready on its device.

    Args:
        folders: of `find_inpainting`.
        settings: uses what trades time for memory.
        sampler: a key of `SAMPLERS`, or model.
        device: where it runs.
        dtype: a key of `DTYPES`.

    Raises:
        DataError: the files do not belong together or are damaged.
    """
    pipeline = load_inpainting(*folders, sampler, DTYPES[dtype])
    if settings.attention_slicing:
        pipeline.enable_attention_slicing()
    if settings.vae_slicing:
        pipeline.vae.enable_slicing()
    if settings.cpu_offload:
        pipeline.enable_model_cpu_offload(device=device)
    else:
        pipeline.to(device)
    return pipeline


def frame_seed(seed: int, name: str) -> int:
    """Returns the seed of a frame's noise: the same on each machine and in each run."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{name}".encode()).digest()[:7], "big")


def as_planes(picture: NDArray[np.float32]) -> torch.Tensor:
    """Returns a picture `[h, w, C]` as a batch `[1, C, h, w]`."""
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1)))[None]
