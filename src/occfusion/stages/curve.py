"""Error against training time, on a fixed handful of held-out images."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import lightning as L

from occfusion.cpu.memory import peak_memory_mb
from occfusion.evaluation.evaluate import evaluate_frames, summarise
from occfusion.files.run_folder import METRICS
from occfusion.files.table import read_table, write_table
from occfusion.perceptual import PerceptualMetric
from occfusion.stages.avatar import AvatarStage
from occfusion.types import Frame, Rendering

COLUMNS = ("stage", "step", "train_seconds", "wall_seconds", *METRICS, "gaussians", "peak_memory_mb")


class ErrorCurve(L.Callback):
    """Evaluates at training times t, 2t, 4t … and at the end; the training clock stands still meanwhile.

    Args:
        path: the table, appended to; rows of this stage beyond the step that a resumed run starts from are dropped.
        frames: the held-out images.
        render: renders a frame with the avatar as it is.
        first_second: t.
        perceptual: the metric of the `lpips` column, None to leave it empty.
    """

    def __init__(
        self,
        path: Path,
        frames: Sequence[Frame],
        render: Callable[[Frame], Rendering],
        first_second: float,
        perceptual: PerceptualMetric | None,
    ) -> None:
        self.path = path
        self.frames = frames
        self.render = render
        self.perceptual = perceptual
        self._next = first_second
        self._wall_started = time.monotonic()
        self._last_step = -1

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Measures the start of a fresh run, or drops what a resumed run will measure again."""
        assert isinstance(pl_module, AvatarStage)
        try:
            rows = read_table(self.path)
            kept = [r for r in rows if r["stage"] != pl_module.name or int(r["step"]) <= trainer.global_step]
        except (KeyError, TypeError, ValueError):
            print(f"{pl_module.name}: {self.path} is damaged; the curve begins here")
            kept = []
        write_table(self.path, COLUMNS, kept)
        while self._next <= pl_module.clock.seconds:
            self._next *= 2
        if trainer.global_step == 0:
            self._measure(trainer, pl_module)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Measures when the next time has come."""
        assert isinstance(pl_module, AvatarStage)
        if pl_module.clock.seconds_of_host >= self._next:
            self._measure(trainer, pl_module)
            while self._next <= pl_module.clock.seconds:
                self._next *= 2

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Measures the end."""
        assert isinstance(pl_module, AvatarStage)
        if trainer.global_step != self._last_step:
            self._measure(trainer, pl_module)

    def _measure(self, trainer: L.Trainer, stage: AvatarStage) -> None:
        with stage.clock.paused():
            seconds = stage.clock.seconds
            was_training = stage.training
            stage.eval()
            full = summarise(evaluate_frames(self.render, self.frames, ("full",), self.perceptual))["full"]
            stage.train(was_training)
            row = {
                "stage": stage.name,
                "step": trainer.global_step,
                "train_seconds": round(seconds, 3),
                "wall_seconds": round(time.monotonic() - self._wall_started, 3),
                **{key: full[key] for key in METRICS},
                "gaussians": stage.num_gaussians,
                "peak_memory_mb": round(peak_memory_mb(), 1),
            }
            write_table(self.path, COLUMNS, [*read_table(self.path), row])
            known = {f"held_out/{key}": value for key in METRICS if (value := full[key]) is not None}
            for logger in trainer.loggers:
                logger.log_metrics(known, trainer.global_step)
        self._last_step = trainer.global_step
