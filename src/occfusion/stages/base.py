"""What the stages share: a name, a clock, the last loss terms, and the guard against non-finite values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import lightning as L
import torch
from torch import Tensor

from occfusion.errors import NumericsError
from occfusion.gpu.sums import total
from occfusion.stages.clock import TrainingClock
from occfusion.types import Frame


class Stage(L.LightningModule):
    """An interface: a training stage with a name and a clock.

    Attributes:
        step_terms: the loss terms of the last step, unweighted; those that it did not ask are not in it.
        step_total: their weighted sum.
        frame: of the step under way; None where steps have none.
    """

    name: str

    def __init__(self) -> None:
        super().__init__()
        self.clock = TrainingClock()
        self.step_terms: dict[str, Tensor] = {}
        self.step_total = torch.zeros(())
        self.frame: Frame | None = None
        self._terms: dict[str, Tensor] = {}

    def __setattr__(self, name: str, value: Any) -> None:
        """Sets an attribute; names of hooks, which Lightning notes forty times a step, by the short way."""
        if name == "_current_fx_name":
            object.__setattr__(self, name, value)  # a module looks for parameters first
        else:
            super().__setattr__(name, value)

    def on_train_start(self) -> None:
        """Starts the training clock."""
        self.clock.start()

    def on_train_end(self) -> None:
        """Stops the training clock."""
        self.clock.stop()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds the training seconds."""
        checkpoint["train_seconds"] = self.clock.seconds

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Takes the training seconds of the earlier run over."""
        self.clock.restore(checkpoint["train_seconds"])

    def counts(self) -> dict[str, int]:
        """Returns what is counted of the thing in training, by the names of the loss table's columns, or nothing."""
        return {}

    def progress_note(self) -> str:
        """Returns what the progress line says of the thing in training, or nothing."""
        return ""

    def keep_terms(self, terms: Mapping[str, Tensor], total: Tensor) -> None:
        """Remembers the terms of this step and their weighted sum.

        For the progress line, a term not built this step keeps its last value.
        """
        self.step_terms = {name: value.detach() for name, value in terms.items()}
        self.step_total = total.detach()
        self._terms.update(self.step_terms)

    def last_terms(self) -> dict[str, float]:
        """Returns the latest value of each loss term, unweighted."""
        return {name: float(value) for name, value in self._terms.items()}


def check_finite_terms(terms: Mapping[str, Tensor], stage: str, step: int, frame: str, total: Tensor) -> None:
    """Looks at the loss terms of a step before anything is made of them.

    Args:
        terms: unweighted.
        stage: for the message, as `step` and `frame`.
        step: that is under way.
        frame: that it sees.
        total: their weighted sum, which is finite only if all of them are.

    Raises:
        NumericsError: naming the first loss term that is not finite, or the sum where it alone is not.
    """
    if math.isfinite(total.detach()):
        return
    where = f"stage {stage}, step {step}, frame {frame}"
    for name, value in terms.items():
        if not math.isfinite(value.detach()):
            raise NumericsError(
                f"{where}: the loss term `{name}` is {float(value.detach())}. "
                f"The state before this step is saved; try smaller learning rates, or look at that frame's data"
            )
    raise NumericsError(
        f"{where}: the weighted sum of the loss terms is {float(total.detach())}, and each of them is finite. "
        f"The state before this step is saved; choose smaller weights"
    )


def check_finite_gradients(groups: Iterable[Mapping[str, Any]], stage: str, step: int, frame: str) -> None:
    """Raises NumericsError naming the first parameter group whose gradient is not finite."""
    named = [
        (str(group["name"]), parameter.grad)
        for group in groups
        for parameter in group["params"]
        if parameter.grad is not None
    ]
    # a sum is finite only if all its parts are, and costs a fraction of testing each, or of a norm; the device is
    # asked once, since each question waits for it
    if not named or math.isfinite(total(gradient for _, gradient in named)):
        return
    for name, gradient in named:
        if not bool(torch.isfinite(gradient).all()):
            raise NumericsError(
                f"stage {stage}, step {step}, frame {frame}: the gradient of `{name}` is not finite. "
                f"The state before this step is saved"
            )
