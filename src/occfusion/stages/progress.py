"""The progress line: loss terms, Gaussians, speed, memory, time left."""

from __future__ import annotations

import sys
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import ProgressBar
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from occfusion.cpu.memory import peak_memory_mb
from occfusion.stages.base import Stage

REFRESH_SECONDS = 0.5
PLAIN_LINES = 10
"""Lines printed in all where the output is not a terminal."""


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes}:{seconds:02d}"


class FrameProgress(ProgressBar):
    """Shows `init 41/100` while frames are predicted; a few plain lines where the output is no terminal."""

    def __init__(self, frames: int) -> None:
        super().__init__()
        self._frames = frames
        self._done = 0

    def on_predict_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Counts a frame."""
        assert isinstance(pl_module, Stage)
        self._done += 1
        line = f"{pl_module.name} {self._done}/{self._frames} frames"
        if sys.stderr.isatty():
            print(f"\r{line}", end="\n" if self._done == self._frames else "", file=sys.stderr, flush=True)
        elif self._done == self._frames or self._done % max(1, self._frames // PLAIN_LINES) == 0:
            print(line, file=sys.stderr, flush=True)


class ProgressLine(ProgressBar):
    """Shows `optim 412/1200  rgb .021 mask .008  6.9k gaussians  8.1 it/s  310 MB  eta 1:37`."""

    def __init__(self, console: Console | None = None) -> None:
        super().__init__()
        self._console = console or Console(file=sys.stderr)
        self._progress: Progress | None = None
        self._task: TaskID | None = None
        self._shown_at = -1.0
        self._first = (0, 0.0)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Opens the bar."""
        assert isinstance(pl_module, Stage)
        self._first = (trainer.global_step, pl_module.clock.seconds)
        if self._console.is_terminal:
            self._progress = Progress(
                TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"),
                console=self._console, auto_refresh=False,
            )  # fmt: skip
            self._progress.start()
            self._task = self._progress.add_task(pl_module.name, total=trainer.max_steps, text="")

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Refreshes the line at most twice a second; without a terminal prints a few plain lines."""
        assert isinstance(pl_module, Stage)
        step, total, now = trainer.global_step, trainer.max_steps, pl_module.clock.seconds
        if self._progress is not None and self._task is not None:
            if now - self._shown_at >= REFRESH_SECONDS or step == total:
                self._shown_at = now
                text = self._text(pl_module, step, total, now)
                self._progress.update(self._task, completed=step, text=text, refresh=True)
        elif step == total or step % max(1, total // PLAIN_LINES) == 0:
            print(f"{pl_module.name} {self._text(pl_module, step, total, now)}", file=sys.stderr, flush=True)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Closes the bar."""
        self._close()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Closes the bar, so that the error's text stands below it."""
        self._close()

    def _close(self) -> None:
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def _text(self, stage: Stage, step: int, total: int, now: float) -> str:
        first_step, first_time = self._first
        speed = (step - first_step) / max(now - first_time, 1e-9)
        terms = " ".join(f"{name} {value:.3g}" for name, value in stage.last_terms().items())
        left = _clock((total - step) / max(speed, 1e-9))
        return (
            f"{step}/{total}  {terms}  {stage.progress_note()}  "
            f"{speed:.1f} it/s  {peak_memory_mb():.0f} MB  eta {left}"
        )
