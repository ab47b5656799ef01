"""Training of the embedded priors (`stage=prior`)."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar

import torch
from torch import Tensor, nn

from occfusion.priors.embedded.diffusion import diffuse, velocity
from occfusion.settings.stages import PriorTrainingSettings
from occfusion.stages.base import Stage, check_finite_gradients, check_finite_terms

Net = TypeVar("Net", bound=nn.Module)


class Batch(Protocol):
    """An interface: what a network is trained on."""

    @property
    def clean(self) -> Tensor:
        """What the network is to tell, `[B, C, S, S]`."""
        ...

    @property
    def conditions(self) -> Any:
        """What the network is conditioned on."""
        ...

    @property
    def weight(self) -> Tensor:
        """Of each pixel in the loss, `[B, 1, S, S]`."""
        ...

    def to(self, device: torch.device | str) -> Batch:
        """Returns the batch on `device`."""
        ...


Loss = Callable[[Any, Any], Tensor | None]
"""Of a network and a batch; None: that of a diffusion model, which is called as `net(noisy, t, conditions)`."""


class PriorStage(Stage, Generic[Net]):
    """Fits a network; keeps an exponential average of its weights, which is the result.

    A diffusion model learns to predict v. A share of the examples is trained at t = 1, where the prediction is the
    posterior mean.

    Args:
        net: the network.
        settings: steps and rates.
        seed: decides noise and times, step by step.
        loss: of a batch.
        term: the loss's name.
    """

    name = "prior"

    def __init__(
        self,
        net: Net,
        settings: PriorTrainingSettings,
        *,
        seed: int,
        loss: Loss = lambda *_: None,
        term: str = "v",
    ) -> None:
        super().__init__()
        self._loss, self._term = loss, term
        self.settings = settings
        self.seed = seed
        self.net: Net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.averaged: Net = copy.deepcopy(self.net).requires_grad_(False)

    def training_step(self, batch: Batch, _batch_idx: int) -> Tensor:
        """Returns the loss of a batch."""
        loss = self._loss(self.net, batch)
        if loss is None:
            loss = self._velocity_error(batch)
        terms = {self._term: loss}
        self.keep_terms(terms, loss)
        check_finite_terms(terms, self.name, self.global_step, "batch", loss)
        return loss

    def _velocity_error(self, batch: Batch) -> Tensor:
        """Returns the weighted squared error of v."""
        clean = batch.clean
        generator = torch.Generator(clean.device).manual_seed(self.seed * 1_000_003 + self.global_step)
        t = torch.rand(len(clean), generator=generator, device=clean.device)
        t[: round(self.settings.at_end * len(t))] = 1.0
        noise = torch.randn(clean.shape, generator=generator, device=clean.device)
        predicted = self.net(diffuse(clean, noise, t), t, batch.conditions)
        error = (predicted - velocity(clean, noise, t)).square() * batch.weight
        return error.sum() / batch.weight.sum()

    def configure_optimizers(self) -> torch.optim.AdamW:
        """Returns AdamW; the rate follows a cosine after a warm-up."""
        groups = [{"params": list(self.net.parameters()), "name": "net"}]
        return torch.optim.AdamW(groups, lr=self.settings.rate, weight_decay=1e-3, betas=(0.9, 0.99))

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        """Returns the batch on `device` (Lightning does not enter frozen records by itself)."""
        return batch.to(device)

    def on_train_batch_start(self, _batch: Any, _batch_idx: int) -> None:
        """Sets the learning rate and moves the average of the weights by the step before.

        The average belongs to the start of a step: a checkpoint is written at the end of one, before any hook of
        this module could run.
        """
        self._average()
        rate = learning_rate(self.global_step, self.settings)
        for group in self.optimizers(use_pl_optimizer=False).param_groups:  # type: ignore[union-attr]
            group["lr"] = rate

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Checks the gradients and bounds their norm."""
        check_finite_gradients(optimizer.param_groups, self.name, self.global_step, "batch")
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)

    @torch.no_grad()
    def _average(self) -> None:
        keep = min(self.settings.averaging, (1 + self.global_step) / (10 + self.global_step))
        for mean, now in zip(self.averaged.parameters(), self.net.parameters(), strict=True):
            mean.lerp_(now, 1.0 - keep)

    def finished(self) -> Net:
        """Returns the averaged network with the last step in it."""
        self._average()
        return self.averaged.eval()


def learning_rate(step: int, settings: PriorTrainingSettings) -> float:
    """Returns the rate at a step: linear warm-up, then half a cosine down to a hundredth."""
    if step < settings.warmup:
        return settings.rate * (step + 1) / settings.warmup
    share = min(1.0, (step - settings.warmup) / max(1, settings.steps - settings.warmup))
    return settings.rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * share)))
