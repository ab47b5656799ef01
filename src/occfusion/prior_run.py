"""Trains an embedded prior: `python train.py stage=prior`."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, IterableDataset

from occfusion.config import Settings
from occfusion.files.atomic import write_json
from occfusion.files.table import write_table
from occfusion.priors.batches import Batch, validation_batches
from occfusion.priors.completion import completion_iou
from occfusion.priors.corpus import SIZE
from occfusion.priors.corpus_folder import Corpus
from occfusion.priors.silhouette import SilhouetteNet
from occfusion.priors.weights import SILHOUETTE, save_net
from occfusion.runfolder import claim_run_folder
from occfusion.stages.checkpointing import Checkpointing, resumable
from occfusion.stages.interruption import Interrupted, SignalGuard
from occfusion.stages.prior import PriorStage
from occfusion.stages.progress import ProgressLine
from occfusion.stages.settings import PriorTrainingSettings

FAST_DEV_EXAMPLES = 16
CURVE = ("step", "train_seconds", "loss", "centre_iou", "half_iou")
WEIGHTS = "prior.safetensors"


def run_prior_training(settings: Settings, *, folder_chosen_by_user: bool) -> dict[str, Any]:
    """Makes the corpus, trains the silhouette prior, writes its weights with a card; returns the card.

    Raises:
        ConfigError: the folder holds another run.
        Interrupted: a signal stopped it; the same command continues.
    """
    training = settings.prior_training
    if settings.trainer.fast_dev_run:
        training = replace(training, examples=FAST_DEV_EXAMPLES, validation=4, steps=1, batch=4)
    folder = claim_run_folder(settings, "corpus", chosen_by_user=folder_chosen_by_user)
    place = Path(training.corpus) if training.corpus else folder / "corpus"
    corpus = Corpus(place, training.examples, settings.seed)
    for made in corpus.prepare():
        if made % max(1, training.examples // 10) == 0:
            print(f"corpus: {made} of {training.examples} silhouettes", flush=True)
    net = SilhouetteNet(tuple(training.widths), training.depth)
    stage = PriorStage(net, training, seed=settings.seed)
    guard = SignalGuard()
    curve = PriorCurve(folder / "error_vs_time.csv", training, settings.seed)
    callbacks: list[L.Callback] = [guard, curve]
    if not settings.trainer.fast_dev_run:
        callbacks.append(Checkpointing(folder / "last.ckpt", settings.trainer.checkpoint_every))
    if settings.trainer.enable_progress_bar:
        callbacks.append(ProgressLine())
    trainer = L.Trainer(
        accelerator=settings.trainer.accelerator, devices=1, max_epochs=-1,
        max_steps=settings.trainer.max_steps or training.steps, max_time=settings.trainer.max_time,
        fast_dev_run=settings.trainer.fast_dev_run, logger=False, enable_checkpointing=False,
        enable_model_summary=False, enable_progress_bar=settings.trainer.enable_progress_bar, callbacks=callbacks,
    )  # fmt: skip

    def read(step: int) -> Batch:
        return corpus.batch(step, training.batch, settings.seed)

    loader = DataLoader(_Steps(read, lambda: trainer.global_step), batch_size=None)
    checkpoint = None if settings.trainer.fast_dev_run else resumable(folder / "last.ckpt")
    with guard:
        trainer.fit(stage, loader, ckpt_path=checkpoint, weights_only=True)
    if guard.received is not None and trainer.global_step < trainer.max_steps:
        raise Interrupted(guard.received, str(folder / "last.ckpt"))
    card = {
        "training": asdict(training) | {"seed": settings.seed},
        "train_seconds": round(stage.clock.seconds, 1),
        "threads": torch.get_num_threads(),
        "validation": curve.last,
        "data": "silhouettes of embedded subjects 0 to 99, made by this package",
    }
    save_net(folder / WEIGHTS, stage.finished(), SILHOUETTE, SIZE, training.widths, training.depth, card)
    write_json(folder / "card.json", card)
    print(f"weights: {folder / WEIGHTS}")
    return card


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
    """Completion on other poses of the training subjects at times t, 2t, 4t … and at the end (`error_vs_time.csv`).

    Args:
        path: the table; rows beyond the step that a resumed run starts from are dropped.
        settings: how many silhouettes, and t.
        seed: of the training; the silhouettes have a seed of their own.
    """

    def __init__(self, path: Path, settings: PriorTrainingSettings, seed: int) -> None:
        self.path = path
        self.last: dict[str, Any] = {}
        self._settings, self._seed = settings, seed
        self._next = settings.validation_first_second
        self._batches: dict[str, list[Batch]] | None = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Drops what a resumed run will measure again."""
        assert isinstance(pl_module, PriorStage)
        write_table(
            self.path, CURVE, [row for row in self._rows() if int(row["step"]) <= trainer.global_step]
        )
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

    def _measure(self, trainer: L.Trainer, stage: PriorStage) -> None:
        if self._batches is None:
            self._batches = validation_batches(self._settings.validation, self._seed + 1)
        device = stage.device
        ious = {kind: _mean_iou(stage.averaged, batches, device) for kind, batches in self._batches.items()}
        self.last = {
            "step": trainer.global_step,
            "train_seconds": round(stage.clock.seconds, 1),
            "loss": round(stage.last_terms()["v"], 5),
            "centre_iou": round(ious["centre"], 4),
            "half_iou": round(ious["half"], 4),
        }
        write_table(self.path, CURVE, [*self._rows(), self.last])

    def _rows(self) -> list[dict[str, Any]]:
        if not self.path.is_file():
            return []
        with self.path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))


def _mean_iou(net: SilhouetteNet, batches: list[Batch], device: torch.device) -> float:
    scores = [completion_iou(net, batch, device) for batch in batches]
    return float(torch.cat(scores).mean())
