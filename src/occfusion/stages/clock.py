"""Training time without evaluation and saving (the clock of `error_vs_time.csv`)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


def synchronised_time() -> float:
    """Returns monotonic seconds after all queued work of the accelerator, if there is one, is done."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.monotonic()


class TrainingClock:
    """Counts training seconds (data wait included); stands still inside `paused`."""

    def __init__(self) -> None:
        self._before = 0.0
        self._started: float | None = None

    def start(self) -> None:
        """Starts counting; a running clock is left alone."""
        if self._started is None:
            self._started = synchronised_time()

    def stop(self) -> None:
        """Stops counting and keeps what was counted."""
        if self._started is not None:
            self._before += synchronised_time() - self._started
            self._started = None

    @property
    def seconds(self) -> float:
        """Seconds counted so far."""
        if self._started is None:
            return self._before
        return self._before + synchronised_time() - self._started

    @property
    def seconds_of_host(self) -> float:
        """Seconds counted so far, without waiting for the accelerator: a step behind at most, and for nothing."""
        return self._before + (0.0 if self._started is None else time.monotonic() - self._started)

    def restore(self, seconds: float) -> None:
        """Sets what earlier runs had counted; a running clock goes on from there."""
        self._before = seconds
        if self._started is not None:
            self._started = synchronised_time()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stops the clock for the length of a `with` block, when it was running."""
        was_running = self._started is not None
        self.stop()
        try:
            yield
        finally:
            if was_running:
                self.start()
