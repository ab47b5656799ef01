"""`losses.csv`: one row a step with every loss term, learning rate and count; the same rows for other loggers."""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch import Tensor

from occfusion.errors import CheckpointError, DataError
from occfusion.files.table import read_table, table_bytes, write_table
from occfusion.stages.base import Stage

BATCH_ROWS = 100
"""Rows that are held back at most, so that files and accelerators are seldom waited for."""
BATCH_SECONDS = 10.0
"""How long a row is held back at most, once another follows it."""
LEADING = ("stage", "step", "total")
RATE = "rate_"
COUNTS = ("gaussians",)


@dataclass(frozen=True)
class StepRecord:
    """What is logged of a step.

    Attributes:
        step: how many steps of the stage are done.
        terms: the loss terms that were asked, unweighted, and their weighted sum `total`, each of one element.
        rates: of each parameter group.
        counts: such as that of the Gaussians.
    """

    step: int
    terms: Mapping[str, Tensor]
    rates: Mapping[str, float]
    counts: Mapping[str, int]


class LossTable:
    """A CSV that rows are appended to; a column that no row had before rewrites it once.

    Args:
        path: of the file, which may exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._columns: list[str] = []

    def open(self, keep: Callable[[Mapping[str, str]], bool]) -> None:
        """Takes up what is there, without the rows that are not kept and without what a stop left of the last one.

        Raises:
            CheckpointError: the file is no such table.
        """
        if not self.path.is_file():
            return
        whole = self.path.read_text(encoding="utf-8").rpartition("\n")[0]
        reader = csv.DictReader(whole.splitlines())
        try:
            rows = [row for row in reader if keep(row)]
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"{self.path}, line {reader.line_num}: not a row of the loss table; move the file away, then the same "
                "command continues with a new one"
            ) from error
        self._columns = list(reader.fieldnames or ())
        write_table(self.path, self._columns, rows)

    def append(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Adds rows; they are on the disk when this returns.

        Raises:
            DataError: the disk refuses.
        """
        columns = _ordered([*self._columns, *(name for row in rows for name in row)])
        if columns != self._columns:
            write_table(self.path, columns, [*read_table(self.path), *rows])
            self._columns = columns
            return
        try:
            with self.path.open("ab") as file:
                file.write(table_bytes(columns, rows, header=False))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise DataError(
                f"{self.path}: cannot be written ({error.strerror or error}); check space and rights."
            ) from error


def _ordered(names: Iterable[str]) -> list[str]:
    """Returns the names once each: stage, step, weighted sum, then terms, rates and counts as they came."""

    def part(name: str) -> int:
        if name in LEADING:
            return LEADING.index(name)
        return len(LEADING) + (2 if name in COUNTS else int(name.startswith(RATE)))

    return sorted(dict.fromkeys(names), key=part)


class LossLog(L.Callback):
    """Writes `losses.csv` in batches, and gives every k-th row to the trainer's loggers.

    Values stay on the accelerator until a batch is written. All rows up to a checkpoint's step are on the disk before
    the checkpoint is, and a resumed run drops those beyond it, so that no row is missing or there twice. This callback
    has to come before the one that saves checkpoints.

    Args:
        path: the table; rows of other stages stay.
        every: steps from one row for the loggers to the next, the first step's among them.
    """

    def __init__(self, path: Path, every: int = 1) -> None:
        self._table = LossTable(path)
        self._every = every
        self._held: list[StepRecord] = []
        self._written_at = time.monotonic()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Drops the rows of steps that will be done again."""
        assert isinstance(pl_module, Stage)
        name, step = pl_module.name, trainer.global_step
        self._table.open(lambda row: row["stage"] != name or int(row["step"]) <= step)
        self._written_at = time.monotonic()

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Takes the step's row; writes when enough have come together."""
        assert isinstance(pl_module, Stage)
        groups = (group for optimizer in trainer.optimizers for group in optimizer.param_groups)
        rates = {group["name"]: float(group["lr"]) for group in groups}
        terms = {"total": pl_module.step_total, **pl_module.step_terms}
        self._held.append(StepRecord(trainer.global_step, terms, rates, pl_module.counts()))
        if len(self._held) >= BATCH_ROWS or time.monotonic() - self._written_at >= BATCH_SECONDS:
            self._write(trainer, pl_module)

    def on_save_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Writes what a run that continues from this checkpoint will not do again."""
        self._write(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Writes the last rows."""
        self._write(trainer, pl_module)

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Writes the last rows before the fault."""
        self._write(trainer, pl_module)

    def _write(self, trainer: L.Trainer, stage: L.LightningModule) -> None:
        assert isinstance(stage, Stage)
        records, self._held = self._held, []
        self._written_at = time.monotonic()
        if not records:
            return
        values = read_together([value for record in records for value in record.terms.values()])
        rows = []
        for record in records:
            terms = {name: next(values) for name in record.terms}
            rates = {f"{RATE}{name}": rate for name, rate in record.rates.items()}
            rows.append({"stage": stage.name, "step": record.step, **terms, **rates, **record.counts})
            if trainer.loggers and (record.step - 1) % self._every == 0:
                curves = {f"loss/{name}": value for name, value in terms.items()}
                curves |= {f"rate/{name}": rate for name, rate in record.rates.items()}
                for logger in trainer.loggers:
                    logger.log_metrics({**curves, **record.counts}, record.step)
        self._table.append(rows)


def read_together(values: Sequence[Tensor]) -> Iterator[float]:
    """Returns an iterator over the values of tensors of one element each; the accelerator is waited for once."""
    return iter(torch.cat([value.reshape(1) for value in values]).tolist())
