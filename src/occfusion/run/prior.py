"""Trains an embedded prior, and the coarse avatars that one of them learns from: `python train.py stage=prior`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, IterableDataset

from occfusion.errors import ConfigError
from occfusion.files.atomic import write_json
from occfusion.files.table import read_table, write_table
from occfusion.prior_training.appearance_task import AppearanceTask, Coarse, CoarseScene
from occfusion.prior_training.completion_task import CompletionTask
from occfusion.prior_training.silhouette_task import SilhouetteTask
from occfusion.prior_training.task import PriorTask
from occfusion.priors.embedded.network_file import load_net, save_net
from occfusion.run.folder import claim_run_folder
from occfusion.run.prepare import build, claim, decide, observe
from occfusion.run.refine import repaint_unseen
from occfusion.run.training import fit
from occfusion.settings.datasets import SyntheticSettings
from occfusion.settings.schema import Settings, StageChoice, optim_hash
from occfusion.settings.stages import PriorTrainingSettings
from occfusion.stages.prior import Batch, PriorStage


def run_prior_training(settings: Settings, *, folder_chosen_by_user: bool) -> dict[str, Any]:
    """Makes the corpus, trains a prior, writes its weights with a card; returns the card.

    Args:
        settings: of the run.
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
    place = Path(training.corpus) if training.corpus else folder.corpus
    task = _make_task(training, place, settings)
    task.prepare()
    L.seed_everything(settings.seed, verbose=False)  # the same network whether the corpus was there or not
    net, started_from = _first_net(task, training)
    stage = PriorStage(net, training, seed=settings.seed, loss=task.loss, term=task.term)
    curve = PriorCurve(folder.curve, training, task)
    batches = DataLoader(_Steps(task.batch, lambda: stage.global_step), batch_size=None)
    done = fit(stage, batches, settings, folder, folder.checkpoint, steps=training.steps, measuring=[curve])
    trained = stage.finished()
    figures = task.finish(trained, stage.device)
    card = {
        "training": {**asdict(training), "seed": settings.seed, "corpus": None, "start": started_from},
        "train_seconds": round(stage.clock.seconds, 1),
        "threads": torch.get_num_threads(),
        "validation": curve.latest() | figures,
        "data": task.data,
    }
    save_net(
        folder.prior_weights, trained, task.kind, task.size, training.widths, training.depth, card, task.version
    )  # fmt: skip
    write_json(folder.prior_card, card)
    print(f"weights: {folder.prior_weights}")
    done.stop_if_asked()
    return card


def train_coarse(settings: Settings, scene: CoarseScene, place: Path) -> Coarse:
    """Trains the coarse avatar of a scene of the inpainter's corpus, or takes up one trained before.

    Args:
        settings: of the training of the prior; variant and plan are those whose coarse avatars it learns from.
        scene: whose avatar.
        place: of its run.

    Raises:
        OccfusionError: as `Run.run_stages`; the variant completes no masks, so nothing would be inpainted after it;
            or the data set is not the embedded one.
    """
    if "init" not in settings.variant.stages:
        raise ConfigError(
            f"stage=prior prior_training=appearance: variant {settings.variant.name} completes no masks, so nothing is "
            f"inpainted after it; leave variant unset, or choose one of B to E"
        )
    if not isinstance(settings.dataset, SyntheticSettings):
        raise ConfigError(
            f"stage=prior prior_training=appearance dataset={settings.dataset.name}: its corpus is of embedded people; "
            "leave dataset unset"
        )
    occlusion = replace(
        settings.dataset.occlusion, kind=scene.occlusion, share=scene.share, fraction=scene.fraction
    )
    own = replace(
        settings,
        stage=StageChoice("optim"),
        dataset=replace(
            settings.dataset,
            scene=scene.scene,
            cameras=2,
            train_frames=[0, scene.frames, 1],
            occlusion=occlusion,
        ),
        evaluation=replace(settings.evaluation, curve=False, perceptual=False),
        seed=scene.seed,
        output_dir=str(place),
    )
    L.seed_everything(own.seed, verbose=False)  # whatever was trained before it in this process
    observed = observe(own)
    assert observed.frames is not None
    plan = decide(own, observed)
    folder = claim(own, observed, plan, folder_chosen_by_user=True)
    run = build(own, observed, plan, folder)
    avatar, data = run.run_stages(), observed.data
    frames = [data.train_frame(k, complete="init" in plan.stages) for k in range(len(data.train_indices))]
    accumulated = repaint_unseen(run.training, avatar)
    return Coarse(avatar.eval(), frames, observed.frames, observed.renderer, accumulated)


def _make_task(training: PriorTrainingSettings, place: Path, settings: Settings) -> PriorTask[Any]:
    if training.network == SilhouetteTask.kind:
        return SilhouetteTask(training, place, settings.seed)
    if training.network == CompletionTask.kind:
        return CompletionTask(training, place, settings.seed)
    if training.network == AppearanceTask.kind:
        return AppearanceTask(
            training, place, settings.seed, optim_hash(settings), partial(train_coarse, settings)
        )
    raise ConfigError(
        f"prior_training.network={training.network!r}: choose silhouette, appearance or completion"
    )


def _first_net(task: PriorTask[Any], training: PriorTrainingSettings) -> tuple[torch.nn.Module, str | None]:
    """Returns the network that training begins with, and the hash of the weights that it has of an earlier one."""
    net: torch.nn.Module = task.make_net()
    if training.start is None:
        return net, None

    where = "prior_training.start"
    _, card = load_net(training.start, task.kind, task.size, lambda *_: net, where, task.version)
    return net.train().requires_grad_(True), str(card["sha256"])


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
    """A task's figures at times t, 2t, 4t … and at the end.

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
        rows = read_table(self.path)
        if self._last or not rows:
            return self._last
        return {
            key: int(value) if key == "step" else float(value) for key, value in rows[-1].items() if value
        }

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Drops what a resumed run will measure again."""
        assert isinstance(pl_module, PriorStage)
        kept = [row for row in read_table(self.path) if int(row["step"]) <= trainer.global_step]
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
            "loss": round(sum(stage.last_terms().values()), 5),
            **{name: round(value, 4) for name, value in figures.items()},
        }
        write_table(self.path, self.columns, [*read_table(self.path), self._last])
