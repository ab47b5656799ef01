"""Writing `last.ckpt` so that a stopped run continues exactly where it was."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import lightning as L
import torch

from occfusion.errors import CheckpointError, NumericsError
from occfusion.stages.base import Stage


def resumable(path: Path) -> Path | None:
    """Returns the checkpoint to continue from, None when there is none.

    Raises:
        CheckpointError: the file is not a whole checkpoint.
    """
    if not path.is_file():
        return None
    try:
        torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise CheckpointError(
            f"{path} is damaged ({str(error).splitlines()[0]}); remove it to start the stage anew"
        ) from error
    return path


class Checkpointing(L.Callback):
    """Saves the trainer's state every `every` steps, at the end, and when an exception ends the run.

    The file is written beside its place and renamed, so an interrupted write leaves the previous one whole.
    """

    def __init__(self, path: Path, every: int) -> None:
        self.path = path
        self.every = every
        self._saved_step = -1

    def save(self, trainer: L.Trainer, stage: Stage) -> None:
        """Writes the checkpoint of the step just finished; saving the same step twice does nothing."""
        if trainer.global_step == self._saved_step:
            return
        with stage.clock.paused():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            partial = self.path.with_suffix(".partial")
            try:
                trainer.save_checkpoint(partial)  # of several processes the first writes, and all wait for it
                if trainer.is_global_zero:
                    os.replace(partial, self.path)
            except OSError as error:
                partial.unlink(missing_ok=True)
                raise CheckpointError(
                    f"{self.path}: cannot be written ({error.strerror or error}); make room, then the same command "
                    "continues from the checkpoint before"
                ) from error
        self._saved_step = trainer.global_step

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Saves every `every` steps."""
        assert isinstance(pl_module, Stage)
        if trainer.global_step % self.every == 0 or trainer.should_stop:
            self.save(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Saves the last step."""
        assert isinstance(pl_module, Stage)
        self.save(trainer, pl_module)

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Saves the last good state when a non-finite value stops the run.

        The guard raises before the optimiser's step, so parameters are those of the step before. After any
        other exception the state may be half a step: the file of the last whole interval stands. So it does where
        several processes train together, for the others do not know of the exception.
        """
        alone = trainer.world_size == 1
        if alone and isinstance(exception, NumericsError) and isinstance(pl_module, Stage):
            self.save(trainer, pl_module)
