"""What a task for an embedded prior gives the training."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn

Net = TypeVar("Net", bound=nn.Module)


@dataclass(frozen=True)
class Batch:
    """What a network is trained on.

    Attributes:
        clean: what it is to tell: signals in -1..1, or colours, `[B, C, S, S]`.
        conditions: what it is shown of them, as its `forward` takes it.
        weight: of each pixel in the loss, `[B, 1, S, S]`, or of each side's.
    """

    clean: Tensor
    conditions: Any
    weight: Tensor

    def to(self, device: torch.device | str) -> Batch:
        """Returns the batch on `device`."""
        return Batch(self.clean.to(device), self.conditions.to(device), self.weight.to(device))


class PriorTask(ABC, Generic[Net]):
    """An interface: data, network and figures of one embedded prior.

    Attributes:
        kind: of network, as its weights name it.
        size: pixels a side of the crop.
        data: what it learns from, for the card.
        columns: names of its figures.
        version: of its network's conditions and prediction.
        term: name of its loss.
    """

    kind: str
    size: int
    data: str
    columns: tuple[str, ...]
    version: int = 1
    term: str = "v"

    @abstractmethod
    def prepare(self) -> None:
        """Makes the corpus, unless it is there."""

    @abstractmethod
    def make_net(self) -> Net:
        """Returns the network, untrained."""

    @abstractmethod
    def batch(self, step: int) -> Batch:
        """Returns the batch of a training step: a function of the step and the seed alone."""

    def loss(self, net: Net, batch: Batch) -> Tensor | None:
        """Returns the loss of a batch; None: that of a diffusion model."""
        return None

    @abstractmethod
    def measure(self, net: Net, device: torch.device) -> dict[str, float]:
        """Returns the figures of a network on data that it is not trained on."""

    def finish(self, net: Net, device: torch.device) -> dict[str, float]:
        """Fits what is fitted once the network is trained; returns figures for the card."""
        return {}
