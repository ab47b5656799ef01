"""Runs what a configuration asks for: stages, evaluation, report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning as L
from omegaconf import DictConfig

from occfusion.cpu.processes import is_helper
from occfusion.files.checkpoint import newest_whole
from occfusion.files.run_folder import STAGES, RunFolder
from occfusion.human import write_gaussians_ply
from occfusion.human.kernels import compile_meanwhile
from occfusion.plan.idle import idle_settings
from occfusion.report.page import write_report
from occfusion.report.tables import print_summary
from occfusion.run.environment import check_machine, quiet_lightning
from occfusion.run.evaluation import PICTURE_FRAMES, evaluate_run
from occfusion.run.folder import at_work, finished_in, identify, record_finished
from occfusion.run.keepsakes import write_before_after, write_turntable
from occfusion.run.prepare import Run, build, claim, decide, make_renderer, observe
from occfusion.run.prior import run_prior_training
from occfusion.run.sequence import record_sequence
from occfusion.settings.schema import PRIOR_STAGE, load_settings, stages_to_run
from occfusion.stages.loggers import check_logger


def run(config: DictConfig, *, folder_chosen_by_user: bool) -> dict[str, Any]:
    """Runs what a composed configuration asks for and returns its figures; see `run_in_folder`."""
    return run_in_folder(config, folder_chosen_by_user=folder_chosen_by_user)[1]


def run_in_folder(
    config: DictConfig, *, folder_chosen_by_user: bool, given: Sequence[str] = ()
) -> tuple[Path, dict[str, Any]]:
    """Runs what a composed configuration asks for; returns the run folder and the figures of its evaluation.

    What the same settings, data and evaluation gave before is taken as it is, unless `evaluation.again`. Where
    nothing is evaluated there are no figures; the training of a prior gives its card in their place.

    Args:
        config: composed.
        folder_chosen_by_user: whether `output_dir` is the user's.
        given: the user's overrides; those that change nothing in this run are told.

    Raises:
        OccfusionError: anything that the user can mend, before training where it can be known before.
        Interrupted: a signal stopped it; the same command continues.
    """
    quiet_lightning()
    settings = load_settings(config)
    check_logger(settings.logger)
    check_machine(settings)
    L.seed_everything(settings.seed, verbose=False)
    if settings.stage.name == PRIOR_STAGE:
        card = run_prior_training(settings, folder_chosen_by_user=folder_chosen_by_user)
        return Path(settings.output_dir), card
    check_checkpoints(RunFolder(Path(settings.output_dir)))
    if stages_to_run(settings) != ["init"] and not is_helper():
        compile_meanwhile(make_renderer(settings))
    observed = observe(settings)
    plan = decide(settings, observed)
    idle = idle_settings(given, settings, plan)
    folder = claim(settings, observed, plan, folder_chosen_by_user=folder_chosen_by_user, idle=idle)
    with at_work(folder):
        identity = identify(settings)
        data = f"{observed.data_hash} {observed.held_out_hash}"
        figures = finished_in(folder, identity, data)
        if figures is None:
            figures = _run_and_evaluate(build(settings, observed, plan, folder))
        if figures:
            record_finished(folder, identity, data)  # where the files lie now
            print_summary(folder.path, figures)
    return folder.path, figures


def check_checkpoints(folder: RunFolder) -> None:
    """Looks for checkpoints that nothing could continue from, before the data are read for that.

    Raises:
        CheckpointError: a stage that is not done has some, and none of them is whole.
    """
    for left in map(folder.stage, STAGES):
        if not left.record.is_file() and not is_helper():
            newest_whole(left.checkpoint)


def _run_and_evaluate(run_: Run) -> dict[str, Any]:
    """Runs the stages of a run, evaluates and reports; returns the figures, none where there are none to be had."""
    avatar, own = run_.run_stages(), run_.training
    settings, folder = own.settings, own.folder
    if is_helper():
        return {}
    record_sequence(folder, own.data, settings)  # of all frames, also of those that no step saw
    if stages_to_run(settings) == ["init"]:  # nothing is trained yet that could be evaluated
        print(f"run folder: {folder.path}")
        return {}
    write_gaussians_ply(folder.point_cloud, avatar.gaussians)  # also where a stage was taken over
    figures = evaluate_run(own, avatar, run_.plan.left_out(), run_.coverage)
    evaluation = settings.evaluation
    if evaluation.pictures and evaluation.turntable and not settings.trainer.fast_dev_run:
        write_before_after(folder, avatar, own.data.spread_train_frames(PICTURE_FRAMES), own.renderer)
        write_turntable(folder, evaluation.turntable)
    write_report(folder)
    return figures
