"""Stopping on a signal between two steps, so that what is saved is a whole step."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any

import lightning as L
import torch

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

    Used as a context around `Trainer.fit`, it takes the signals before the trainer prepares itself, for Lightning
    answers SIGINT by exiting with 1; and it gives them back as they were, whatever the trainer did to them. Where
    Lightning would exit over a signal that is noted, it does not: whoever uses the guard looks at `received`. A second
    signal of the same kind ends the process at once.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> SignalGuard:
        self._before = {number: signal.getsignal(number) for number in SIGNALS}
        self._take()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> bool:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        return self.received is not None and kind is not None and issubclass(kind, SystemExit)

    def _take(self) -> None:
        for number in SIGNALS:
            signal.signal(number, self._note)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.received == number:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        self.received = number

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Takes the two signals again, from Lightning, which would exit with 0 on SIGTERM."""
        self._take()

    def on_predict_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Takes the two signals again; the frames that are predicted must end when one has come."""
        self._take()

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        """Stops the loop when a signal has come, to any of the processes that train together."""
        if trainer.world_size > 1:  # a process that stopped alone would be waited for
            own = torch.tensor(float(self.received or 0), device=trainer.strategy.root_device)
            self.received = int(trainer.strategy.reduce(own, reduce_op="max")) or None
        if self.received is not None:
            trainer.should_stop = True
