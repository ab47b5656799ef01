"""A variance-preserving diffusion in continuous time: cosine schedule, v-prediction, sampling.

At time t in [0, 1] a clean signal x becomes `x_t = alpha(t) x + sigma(t) noise` with alpha = cos(pi t / 2) and
sigma = sin(pi t / 2) (Nichol and Dhariwal 2021, without their offset). A network that predicts
`v = alpha noise - sigma x` (Salimans and Ho 2022, §4) is well conditioned at both ends: at t = 1, v = -x, so one
evaluation there is the posterior mean of x.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

Predictor = Callable[[Tensor, Tensor], Tensor]
"""Maps `(x_t [B, C, H, W], t [B])` to the prediction of v, of x_t's shape."""


def alpha_sigma(t: Tensor) -> tuple[Tensor, Tensor]:
    """Returns `alpha(t)` and `sigma(t)`, of the shape of `t`."""
    angle = 0.5 * math.pi * t
    return torch.cos(angle), torch.sin(angle)


def _expanded(values: Tensor, like: Tensor) -> Tensor:
    return values.reshape(-1, *([1] * (like.dim() - 1)))


def diffuse(clean: Tensor, noise: Tensor, t: Tensor) -> Tensor:
    """Returns `x_t`, of the shape of `clean [B, ...]`; `t [B]`."""
    alpha, sigma = (_expanded(part, clean) for part in alpha_sigma(t))
    return alpha * clean + sigma * noise


def velocity(clean: Tensor, noise: Tensor, t: Tensor) -> Tensor:
    """Returns what the network is to predict, `v = alpha noise - sigma clean`."""
    alpha, sigma = (_expanded(part, clean) for part in alpha_sigma(t))
    return alpha * noise - sigma * clean


def clean_and_noise(noisy: Tensor, v: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the clean signal and the noise that `x_t` and a prediction of v stand for."""
    alpha, sigma = (_expanded(part, noisy) for part in alpha_sigma(t))
    return alpha * noisy - sigma * v, sigma * noisy + alpha * v


@torch.no_grad()
def sample(predict: Predictor, noise: Tensor, steps: int) -> Tensor:
    """Returns a sample by DDIM (Song et al. 2021, eq. 12 with eta 0), clipped to [-1, 1]; noise alone decides it.

    Args:
        predict: the network with its conditions.
        noise: the start, standard normal, `[B, C, H, W]`.
        steps: evaluations of the network, at least 1.

    Raises:
        ValueError: `steps` is below 1.
    """
    if steps < 1:
        raise ValueError(f"steps must be at least 1; got {steps}")
    times = torch.linspace(1.0, 0.0, steps + 1, dtype=noise.dtype, device=noise.device)
    x = noise
    for now, after in pairwise(times):
        t = now.expand(noise.shape[0])
        clean = clean_and_noise(x, predict(x, t), t)[0].clamp(-1.0, 1.0)
        (alpha, sigma), (alpha_after, sigma_after) = alpha_sigma(now), alpha_sigma(after)
        # the clipped signal goes with the noise that would make x of it
        x = alpha_after * clean + sigma_after * ((x - alpha * clean) / sigma)
    return x.clamp(-1.0, 1.0)


@torch.no_grad()
def posterior_mean(predict: Predictor, noise: Tensor) -> Tensor:
    """Returns the mean of the clean signal given the conditions: one evaluation at t = 1, in [-1, 1]."""
    t = torch.ones(noise.shape[0], dtype=noise.dtype, device=noise.device)
    return (-predict(noise, t)).clamp(-1.0, 1.0)
