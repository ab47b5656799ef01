"""Runs what a configuration asks for: stages, evaluation, report."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import lightning as L
from omegaconf import DictConfig

from occfusion.cpu.processes import is_helper
from occfusion.prior_training.appearance_task import Coarse, CoarseScene
from occfusion.report.page import write_report
from occfusion.report.tables import print_summary
from occfusion.run.coarse import train_coarse
from occfusion.run.evaluation import evaluate_run
from occfusion.run.finished import finished_in, record_finished
from occfusion.run.folder import at_work
from occfusion.run.objects import Run, compose_run
from occfusion.run.prior import run_prior_training
from occfusion.run.stages import run_stages
from occfusion.settings.schema import PRIOR_STAGE, load_settings, stages_to_run
from occfusion.stages.loggers import check_logger


def run(config: DictConfig, *, folder_chosen_by_user: bool) -> dict[str, Any]:
    """Runs what a composed configuration asks for and returns the content of `metrics.json`; see `run_in_folder`."""
    return run_in_folder(config, folder_chosen_by_user=folder_chosen_by_user)[1]


def run_in_folder(config: DictConfig, *, folder_chosen_by_user: bool) -> tuple[Path, dict[str, Any]]:
    """Runs what a composed configuration asks for; returns the run folder and the content of `metrics.json`.

    What the same settings, data and evaluation gave before is taken as it is, unless `evaluation.again`.

    Raises:
        OccfusionError: anything that the user can mend, before training where it can be known before.
        Interrupted: a signal stopped it; the same command continues.
    """
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    settings = load_settings(config)
    check_logger(settings.logger)
    L.seed_everything(settings.seed, verbose=False)
    if settings.stage.name == PRIOR_STAGE:

        def train(scene: CoarseScene, folder: Path) -> Coarse:
            return train_coarse(settings, scene, folder)

        done = run_prior_training(settings, train, folder_chosen_by_user=folder_chosen_by_user)
        return Path(settings.output_dir), done
    run_ = compose_run(settings, folder_chosen_by_user)
    with at_work(run_.folder):
        return _run_and_evaluate(run_)


def _run_and_evaluate(run_: Run) -> tuple[Path, dict[str, Any]]:
    """Runs the stages that are asked for, evaluates and reports; returns the folder and `metrics.json`."""
    settings = run_.settings
    if (finished := finished_in(run_.folder, settings, run_.data_hash)) is not None:
        record_finished(run_.folder, settings, run_.data_hash)  # where the files lie now
        print_summary(run_.folder, finished.metrics)
        return run_.folder, finished.metrics
    run_stages(run_)
    if is_helper():
        return run_.folder, {}
    if stages_to_run(settings) == ["init"]:  # nothing is trained yet that could be evaluated
        print(f"run folder: {run_.folder}")
        return run_.folder, {}
    metrics = evaluate_run(
        run_.folder, run_.data, run_.render, settings, run_.perceptual,
        gaussians=run_.avatar.gaussians.num_gaussians, body=run_.avatar.body, coverage=run_.coverage,
    )  # fmt: skip
    write_report(run_.folder)
    record_finished(run_.folder, settings, run_.data_hash)
    print_summary(run_.folder, metrics)
    return run_.folder, metrics
