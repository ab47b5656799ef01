"""Stopping on a signal between two steps, so that what is saved is a whole step."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any

import lightning as L

from occfusion.errors import OccfusionError

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(OccfusionError):
    """A signal asked the run to stop; everything up to this step is saved.

    Attributes:
        exit_code: 128 plus the signal's number, as a shell expects it.
    """

    def __init__(self, signal_number: int, where: str) -> None:
        name = signal.Signals(signal_number).name
        super().__init__(f"stopped by {name}; saved in {where}: the same command continues")
        self.exit_code = 128 + signal_number


class SignalGuard(L.Callback):
    """Notes SIGINT and SIGTERM and asks the trainer to stop after the step under way.

    A second signal of the same kind ends the process at once.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict[int, Any] = {}

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.received == number:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        self.received = number

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Takes the two signals over from Lightning, which would exit with 0 on SIGTERM."""
        for number in SIGNALS:
            self._previous[number] = signal.signal(number, self._note)

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        """Stops the loop when a signal has come."""
        if self.received is not None:
            trainer.should_stop = True

    def teardown(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Gives the signals back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()
