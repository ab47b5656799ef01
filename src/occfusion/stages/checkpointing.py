"""Writing `last.ckpt` so that a stopped run continues exactly where it was."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np

from occfusion.errors import CheckpointError, NumericsError
from occfusion.files.atomic import atomic_write
from occfusion.files.checkpoint import newest_whole
from occfusion.files.run_folder import StageFolder
from occfusion.stages.base import Stage
from occfusion.types import Frame


def resumable(path: Path, stage: Stage) -> Path | None:
    """Returns the checkpoint to continue a stage from, the newest that is whole; None when there is none.

    Raises:
        CheckpointError: there are some, and none is whole.
    """
    found, problems = newest_whole(path, stage.state_dict().keys())
    if problems:
        print("; ".join([*problems, f"{stage.name}: continues from {found}, the one before"]))
    return found


def keep_step(path: Path, frame: Frame, stage: str, step: int, why: str) -> None:
    """Writes the frame of a step, and which step it was, whole or not at all."""
    pose, camera = frame.pose, frame.camera
    tensors = {
        "rgb": frame.rgb, "visible_mask": frame.visible_mask, "viewmat": camera.viewmat, "K": camera.K,
        "betas": pose.betas, "global_orient": pose.global_orient, "body_pose": pose.body_pose, "transl": pose.transl,
    }  # fmt: skip
    if frame.complete_mask is not None:
        tensors["complete_mask"] = frame.complete_mask
    about = {"stage": stage, "step": step, "frame": frame.name, "why": why}
    content: dict[str, Any] = {name: value.detach().cpu().numpy() for name, value in tensors.items()}
    content |= {name: np.asarray(value) for name, value in about.items()}
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **content)


PATIENCE = 45.0
"""Seconds after which a step is saved though it is not its turn: a killed process loses less than a minute."""


class Checkpointing(L.Callback):
    """Saves the trainer's state every `every` steps, where those take long, at the end, and when an exception ends it.

    The file is written beside its place and renamed, so an interrupted write leaves the previous one whole. That one
    stays beside it, for where a disk damages the newest.
    """

    def __init__(self, path: Path, every: int) -> None:
        self.path = path
        self.every = every
        self._saved_step = -1
        self._saved_at = time.monotonic()

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
                    if self.path.is_file():
                        os.replace(self.path, StageFolder(self.path.parent).earlier_checkpoint)
                    os.replace(partial, self.path)
            except OSError as error:
                partial.unlink(missing_ok=True)
                raise CheckpointError(
                    f"{self.path}: cannot be written ({error.strerror or error}); make room, then the same command "
                    "continues from the checkpoint before"
                ) from error
        self._saved_step, self._saved_at = trainer.global_step, time.monotonic()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Starts the clock."""
        self._saved_at = time.monotonic()

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Saves every `every` steps, and when the last time is long ago, which several processes would not agree on."""
        assert isinstance(pl_module, Stage)
        is_late = trainer.world_size == 1 and time.monotonic() - self._saved_at >= PATIENCE
        if trainer.global_step % self.every == 0 or trainer.should_stop or is_late:
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
            place = StageFolder(self.path.parent).bad_step
            if pl_module.frame is not None:
                keep_step(place, pl_module.frame, pl_module.name, trainer.global_step, str(exception))
                print(f"kept for `python -m occfusion replay {place}`", file=sys.stderr)
