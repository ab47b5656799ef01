"""Training one scene in several processes: Lightning's DDP, made to stand edits of the parameters."""

from __future__ import annotations

import gc
from typing import Any

import lightning as L
from lightning.pytorch.plugins.environments import LightningEnvironment
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor
from torch.nn import Parameter

SUMS = ("gradient_sum", "count")
"""What a densifier collects between rounds."""


class AvatarDDP(DDPStrategy):
    """Averages gradients over the processes, each of which renders another frame.

    Parameters without a gradient in a step, such as the skinning network between its turns, keep none. When
    densification has put other parameters in the place of those that were wrapped, they are wrapped anew.
    """

    def __init__(self) -> None:
        # buffers follow from parameters and step, which are equal everywhere
        super().__init__(
            cluster_environment=LightningEnvironment(), find_unused_parameters=True, broadcast_buffers=False
        )
        self._wrapped: list[Parameter] = []

    def configure_ddp(self) -> None:
        """Wraps the module, and remembers which parameters it had."""
        super().configure_ddp()
        assert self.lightning_module is not None
        self._wrapped = list(self.lightning_module.parameters())

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Wraps the module again where its parameters have been replaced."""
        assert self.lightning_module is not None
        now = list(self.lightning_module.parameters())
        if len(now) != len(self._wrapped) or any(a is not b for a, b in zip(now, self._wrapped, strict=True)):
            self.model = self.lightning_module
            gc.collect()  # the old wrapper's hooks on what was not replaced go with it
            self.configure_ddp()


class SharedDensification(L.Callback):
    """Adds up what the processes have observed before a round, so that all of them edit alike."""

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Comes before the module's own hook, which does the round."""
        densifier = getattr(pl_module, "densifier", None)
        if densifier is not None and trainer.world_size > 1 and densifier.is_due(trainer.global_step):
            for name in SUMS:
                setattr(densifier, name, _total(trainer, getattr(densifier, name)))

    def on_save_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Saves each process's share of the sums, since all of them will load what the first has written."""
        densifier = getattr(pl_module, "densifier", None)
        if densifier is not None and trainer.world_size > 1:
            for name in SUMS:
                share = _total(trainer, getattr(densifier, name)) / trainer.world_size
                checkpoint["state_dict"][f"densifier.{name}"] = share


def _total(trainer: L.Trainer, own: Tensor) -> Tensor:
    total = trainer.strategy.reduce(own.clone(), reduce_op="sum")
    assert isinstance(total, Tensor)
    return total
