"""The score of Stable Diffusion 1.5 under a skeleton; occupancy is a grey picture, diffused as a latent (§4.2)."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from occfusion.observation.crop import PersonView
from occfusion.priors.distillation import guided
from occfusion.priors.score import ScorePrior
from occfusion.priors.sd15.canvas import draw_keypoints
from occfusion.priors.sd15.loading import load_denoiser, require_packages
from occfusion.priors.sd15.model_folder import SCORE_CONTROLNET, SCORE_MODEL, find_model, fingerprint
from occfusion.priors.sd15.settings import DTYPES, Sd15ScoreSettings, resolve_device

PICTURE = 256
"""Pixels a side of the picture that is encoded, as in the authors' code: a latent of 32 x 32."""
COARSENESS = 8
LATENT_CHANNELS = 4


class Sd15Score(ScorePrior[Tensor]):
    """Predicts noise in the latent of an occupancy map by Stable Diffusion with ControlNet.

    Args:
        settings: models and prompts.
        device: where they run, unless the settings say it.

    Raises:
        ConfigError: a package is missing, or a setting is wrong.
        DataError: a model is missing, incomplete or damaged.
    """

    name = "sd15"
    size = PICTURE
    signal_shape = (LATENT_CHANNELS, PICTURE // COARSENESS, PICTURE // COARSENESS)

    def __init__(self, settings: Sd15ScoreSettings, device: torch.device | str = "cpu") -> None:
        self.settings = settings
        self.device, self.dtype = resolve_device(settings.device, settings.dtype, device)
        folders = find_score_models(settings)
        kinds = (SCORE_MODEL, SCORE_CONTROLNET)
        self.hashes = [fingerprint(*pair) for pair in zip(folders, kinds, strict=True)]
        parts = load_denoiser(*folders, DTYPES[self.dtype], settings.prompts)
        self.unet, self.controlnet = parts.unet.to(self.device), parts.controlnet.to(self.device)
        self.vae = parts.vae.to(self.device)
        self.positive, self.negative = (text.to(self.device) for text in parts.texts)
        self.kept = parts.kept

    def describe(self) -> dict[str, Any]:
        """Returns prompts, precision, and the hashes of the models."""
        places = {
            "model",
            "controlnet",
            "model_revision",
            "controlnet_revision",
            "local_files_only",
            "device",
        }
        own = {key: value for key, value in asdict(self.settings).items() if key not in places}
        hashes = dict(zip(("model_hash", "controlnet_hash"), self.hashes, strict=True))
        return {"prior": self.name, **own, "dtype": self.dtype, **hashes}

    def encode_conditions(self, view: PersonView) -> Tensor:
        """Returns the canvas of the skeleton, `[1, 3, S, S]`, 0..1; self-occluded joints are left out."""
        canvas = draw_keypoints(view.seen(view.body()), view.size, view.size)
        planes = torch.from_numpy(canvas).permute(2, 0, 1)[None]
        return planes.to(self.device, DTYPES[self.dtype]) / 255.0

    def encode(self, occupancy: Tensor) -> Tensor:
        """Returns the mean of the VAE's latent, scaled, `[1, 4, S / 8, S / 8]`; float32 throughout."""
        picture = 2.0 * occupancy.float().expand(-1, 3, -1, -1) - 1.0
        latent: Tensor = self.vae.encode(picture).latent_dist.mean * self.vae.config.scaling_factor
        return latent

    def levels(self, t: float) -> tuple[float, float]:
        """Returns the levels of the model's own schedule at the nearest of its steps."""
        kept = float(self.kept[self._step(t)])
        return kept**0.5, (1.0 - kept) ** 0.5

    @torch.no_grad()
    def predict_noise(self, noisy: Tensor, t: float, conditions: Tensor, guidance: float) -> Tensor:
        """Returns the noise; the canvas is a condition of both predictions, the prompts tell them apart."""
        if guidance == 1.0:
            return self._predict(noisy, t, conditions, self.positive)
        negative = self._predict(noisy, t, conditions, self.negative)
        if guidance == 0.0:
            return negative
        return guided(negative, self._predict(noisy, t, conditions, self.positive), guidance)

    def _predict(self, noisy: Tensor, t: float, canvas: Tensor, text: Tensor) -> Tensor:
        latent, step = noisy.to(DTYPES[self.dtype]), torch.tensor([self._step(t)], device=self.device)
        down, middle = self.controlnet(
            latent, step, encoder_hidden_states=text, controlnet_cond=canvas,
            conditioning_scale=self.settings.control_scale, return_dict=False,
        )  # fmt: skip
        predicted: Tensor = self.unet(
            latent, step, encoder_hidden_states=text, down_block_additional_residuals=down,
            mid_block_additional_residual=middle, return_dict=False,
        )[0]  # fmt: skip
        return predicted.float()

    def _step(self, t: float) -> int:
        return min(max(round(t * len(self.kept)), 0), len(self.kept) - 1)


def find_score_models(settings: Sd15ScoreSettings) -> tuple[Any, Any]:
    """Returns the folders of the two models, nothing loaded.

    Raises:
        ConfigError: a package is missing.
        DataError: a model is missing or incomplete.
    """
    require_packages(cpu_offload=False)
    only = settings.local_files_only
    return (
        find_model(SCORE_MODEL, settings.model, settings.model_revision, only),
        find_model(SCORE_CONTROLNET, settings.controlnet, settings.controlnet_revision, only),
    )
