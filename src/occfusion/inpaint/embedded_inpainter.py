"""The embedded inpainter: our own diffusion model of what a coarse rendering lacks, weights in the package."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from occfusion.fields import setting, with_default
from occfusion.inpaint.appearance_net import SIZE, from_signal, load_appearance_net, take_planes
from occfusion.inpaint.partial import Inpainter, Partial, Picture
from occfusion.priors.embedded.diffusion import posterior_mean, sample
from occfusion.priors.embedded.silhouette_prior import EmbeddedSettings


@dataclass(frozen=True)
class EmbeddedInpainterSettings:
    """Settings of the embedded inpainter."""

    samples: int = setting(
        0,
        "posterior samples a frame, whose mean is the picture; 0: the posterior mean, by `draws` evaluations of the "
        "network",
        0,
    )
    draws: int = setting(1, "evaluations of the posterior mean, each with other noise", 1)
    steps: int = setting(10, "evaluations for each sample", 1)
    seed: int = with_default(EmbeddedSettings, "seed", 0)
    weights: str | None = setting(
        None, "a `.safetensors` file of `stage=prior prior_training=appearance`; null: the package's"
    )


class EmbeddedInpainter(Inpainter):
    """Adds to the coarse rendering what it lacks, in a square crop around the body.

    Args:
        settings: how the posterior is summarised.
        device: where the network runs.
    """

    name = "embedded"

    def __init__(self, settings: EmbeddedInpainterSettings, device: torch.device | str = "cpu") -> None:
        self.settings = settings
        self.device = torch.device(device)
        self.net, self.card = load_appearance_net(settings.weights)
        self.net.to(self.device)

    def describe(self) -> dict[str, Any]:
        """Returns the settings and the hash of the weights."""
        own = {key: value for key, value in vars(self.settings).items() if key != "weights"}
        return {"inpainter": self.name, "weights_sha256": self.card["sha256"], **own}

    @torch.no_grad()
    def inpaint(self, partial: Partial) -> Picture:
        """Returns the coarse rendering with the difference that the network expects added."""
        square, planes = take_planes(partial)
        difference = from_signal(self.signal(torch.from_numpy(planes)[None].to(self.device)))[0].cpu().numpy()
        height, width = partial.alpha.shape
        whole = np.stack([square.put(plane, height, width, 0.0) for plane in difference], axis=-1)
        return np.clip(partial.coarse + whole, 0.0, 1.0).astype(np.float32)

    def signal(self, planes: Tensor) -> Tensor:
        """Returns the posterior's mean of the signal, `[B, 3, S, S]`, for planes `[B, 15, S, S]`."""
        settings = self.settings
        count = settings.samples or settings.draws
        generator = torch.Generator().manual_seed(settings.seed)
        noise = torch.randn(count, 3, SIZE, SIZE, generator=generator).to(self.device)
        predict = partial(self.net, planes=planes)
        total = torch.zeros_like(planes[:, :3])
        for one in noise:  # one after the other: the memory of a single crop
            start = one.expand(len(planes), -1, -1, -1)
            total += (
                sample(predict, start, settings.steps) if settings.samples else posterior_mean(predict, start)
            )
        return total / count
