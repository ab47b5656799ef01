"""Trains an embedded prior: `python train.py stage=prior`."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, IterableDataset

from occfusion.errors import ConfigError
from occfusion.files.atomic import write_json
from occfusion.files.table import write_table
from occfusion.prior_training.appearance_task import AppearanceTask, TrainCoarse
from occfusion.prior_training.silhouette_task import SilhouetteTask
from occfusion.prior_training.task import PriorTask
from occfusion.priors.embedded.network_file import save_net
from occfusion.run.folder import claim_run_folder
from occfusion.settings.schema import Settings, optim_hash
from occfusion.settings.stages import PriorTrainingSettings
from occfusion.stages.checkpointing import Checkpointing, resumable
from occfusion.stages.interruption import Interrupted, SignalGuard
from occfusion.stages.loggers import Place, make_logs
from occfusion.stages.prior import Batch, PriorStage
from occfusion.stages.progress import ProgressLine

WEIGHTS = "prior.safetensors"


def run_prior_training(
    settings: Settings, train_coarse: TrainCoarse, *, folder_chosen_by_user: bool
) -> dict[str, Any]:
    """Makes the corpus, trains a prior, writes its weights with a card; returns the card.

    Args:
        settings: of the run.
        train_coarse: trains the coarse avatar of a scene, for the inpainter's corpus.
        folder_chosen_by_user: whether `output_dir` was named.

    Raises:
        ConfigError: the folder holds another run, or no such network.
        Interrupted: a signal stopped it; the same command continues.
    """
    training = settings.prior_training
    if settings.trainer.fast_dev_run:
        training = replace(training, examples=16, subjects=1, validation=4, steps=1, batch=4)
    identity = hashlib.sha256(json.dumps(asdict(training), sort_keys=True).encode()).hexdigest()[:16]
    folder = claim_run_folder(settings, identity, chosen_by_user=folder_chosen_by_user)
    place = Path(training.corpus) if training.corpus else folder / "corpus"
    task = _make_task(training, place, settings, train_coarse)
    task.prepare()
    L.seed_everything(settings.seed, verbose=False)  # the same network whether the corpus was there or not
    stage = PriorStage(task.make_net(), training, seed=settings.seed)
    guard = SignalGuard()
    curve = PriorCurve(folder / "error_vs_time.csv", training, task)
    checkpoint = None if settings.trainer.fast_dev_run else resumable(folder / "last.ckpt")
    logged = Place(folder, stage.name, checkpoint, is_trial=settings.trainer.fast_dev_run)
    logs = make_logs(settings.logger, logged, asdict(settings))
    callbacks: list[L.Callback] = [guard, curve, *logs.callbacks]
    if not settings.trainer.fast_dev_run:
        callbacks.append(Checkpointing(folder / "last.ckpt", settings.trainer.checkpoint_every))
    if settings.trainer.enable_progress_bar:
        callbacks.append(ProgressLine())
    trainer = L.Trainer(
        accelerator=settings.trainer.accelerator, devices=1, max_epochs=-1,
        max_steps=settings.trainer.max_steps or training.steps, max_time=settings.trainer.max_time,
        fast_dev_run=settings.trainer.fast_dev_run, logger=logs.loggers or False, enable_checkpointing=False,
        enable_model_summary=False, enable_progress_bar=settings.trainer.enable_progress_bar, callbacks=callbacks,
    )  # fmt: skip
    loader = DataLoader(_Steps(task.batch, lambda: trainer.global_step), batch_size=None)
    with guard:
        trainer.fit(stage, loader, ckpt_path=checkpoint, weights_only=True)
    if guard.received is not None and trainer.global_step < trainer.max_steps:
        raise Interrupted(guard.received, str(folder / "last.ckpt"))
    trained = stage.finished()
    figures = task.finish(trained, stage.device)
    card = {
        "training": asdict(training) | {"seed": settings.seed},
        "train_seconds": round(stage.clock.seconds, 1),
        "threads": torch.get_num_threads(),
        "validation": curve.latest() | figures,
        "data": task.data,
    }
    save_net(
        folder / WEIGHTS, trained, task.kind, task.size, training.widths, training.depth, card, task.version
    )  # fmt: skip
    write_json(folder / "card.json", card)
    print(f"weights: {folder / WEIGHTS}")
    return card


def _make_task(
    training: PriorTrainingSettings, place: Path, settings: Settings, train_coarse: TrainCoarse
) -> PriorTask[Any]:
    if training.network == SilhouetteTask.kind:
        return SilhouetteTask(training, place, settings.seed)
    if training.network == AppearanceTask.kind:
        return AppearanceTask(training, place, settings.seed, optim_hash(settings), train_coarse)
    raise ConfigError(f"prior_training.network={training.network!r}: choose silhouette or appearance")


class _Steps(IterableDataset[Batch]):
    """Batches from a given step on."""

    def __init__(self, read: Callable[[int], Batch], first_step: Callable[[], int]) -> None:
        self._read, self._first_step = read, first_step

    def __iter__(self) -> Iterator[Batch]:
        step = self._first_step()
        while True:
            yield self._read(step)
            step += 1


class PriorCurve(L.Callback):
    """A task's figures at times t, 2t, 4t … and at the end (`error_vs_time.csv`).

    Args:
        path: the table; rows beyond the step that a resumed run starts from are dropped.
        settings: t.
        task: measures.
    """

    def __init__(self, path: Path, settings: PriorTrainingSettings, task: PriorTask[Any]) -> None:
        self.path = path
        self._last: dict[str, Any] = {}
        self._task = task
        self._next = settings.validation_first_second

    @property
    def columns(self) -> tuple[str, ...]:
        """Returns the columns of the table."""
        return ("step", "train_seconds", "loss", *self._task.columns)

    def latest(self) -> dict[str, Any]:
        """Returns the last figures; of the table where this call had nothing left to train."""
        rows = self._rows()
        if self._last or not rows:
            return self._last
        return {
            key: int(value) if key == "step" else float(value) for key, value in rows[-1].items() if value
        }

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Drops what a resumed run will measure again."""
        assert isinstance(pl_module, PriorStage)
        kept = [row for row in self._rows() if int(row["step"]) <= trainer.global_step]
        write_table(self.path, self.columns, kept)
        while self._next <= pl_module.clock.seconds:
            self._next *= 2

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Measures when the next time has come, and at the last step."""
        assert isinstance(pl_module, PriorStage)
        if pl_module.clock.seconds >= self._next or trainer.global_step == trainer.max_steps:
            with pl_module.clock.paused():
                self._measure(trainer, pl_module)
            while self._next <= pl_module.clock.seconds:
                self._next *= 2

    def _measure(self, trainer: L.Trainer, stage: PriorStage[Any]) -> None:
        figures = self._task.measure(stage.averaged, stage.device)
        self._last = {
            "step": trainer.global_step,
            "train_seconds": round(stage.clock.seconds, 1),
            "loss": round(stage.last_terms()["v"], 5),
            **{name: round(value, 4) for name, value in figures.items()},
        }
        write_table(self.path, self.columns, [*self._rows(), self._last])

    def _rows(self) -> list[dict[str, Any]]:
        if not self.path.is_file():
            return []
        with self.path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
