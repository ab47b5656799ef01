"""Runs the stages of a run: masks, optimisation, refinement."""

from __future__ import annotations

import shutil
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import lightning as L

from occfusion.cpu.processes import is_helper, tell_helpers
from occfusion.files.atomic import write_json
from occfusion.human import load_avatar, save_avatar, write_gaussians_ply
from occfusion.human.densify import Densifier
from occfusion.plan import make as planning
from occfusion.priors.build_prior import make_score_prior
from occfusion.run.evaluation import evaluation_metric
from occfusion.run.masks import run_init
from occfusion.run.objects import Run, device_of
from occfusion.run.references import file_digest, make_references, own_outlines
from occfusion.run.sharing import offer, shared_folder, sole_maker, take
from occfusion.run.start import start_as_observed
from occfusion.settings.schema import Settings, optim_hash
from occfusion.settings.stages import AvatarSettings
from occfusion.stages.avatar import AvatarStage
from occfusion.stages.checkpointing import Checkpointing, resumable
from occfusion.stages.curve import ErrorCurve
from occfusion.stages.distil import Distiller
from occfusion.stages.interruption import Interrupted, SignalGuard
from occfusion.stages.loggers import Logs, Pictured, Place, make_logs
from occfusion.stages.losses_log import LOSS_TABLE
from occfusion.stages.optim import OptimStage
from occfusion.stages.parallel import SharedDensification, trainer_options
from occfusion.stages.progress import ProgressLine
from occfusion.stages.refine import RefineStage
from occfusion.stages.targets import UncertainMasks
from occfusion.types import Frame

WARM_UP_SAID = 0.05
"""Seconds from which on the user is told of the rasteriser's warming up."""

CURVE_TABLE = "error_vs_time.csv"
TABLES = (CURVE_TABLE, LOSS_TABLE)
"""What a stage leaves in the run folder besides its own folder; it is shared with the stage's result."""


def run_stages(run_: Run) -> None:
    """Runs the stages of a run, in order; what is done already is taken over.

    Raises:
        Interrupted: a signal stopped it; the same command continues.
    """
    for stage in run_.plan.stages:
        if stage == "init":
            _complete_masks(run_)
        else:
            _run_stage(run_, stage)


def _complete_masks(run_: Run) -> None:
    """Runs the initialisation stage."""
    assert run_.observed_frames is not None
    run_init(
        run_.settings,
        run_.folder,
        run_.data,
        run_.avatar.body,
        run_.observed_frames,
        run_.data_hash,
        device_of(run_.settings),
    )


def _run_stage(run_: Run, name: str) -> None:
    """Trains a stage, or takes its result over when it is finished already."""
    settings, folder = run_.settings, run_.folder / name
    finished = folder / "avatar.safetensors"
    if (folder / "stage.json").is_file() and finished.is_file():
        print(f"{name}: finished before, taken from {folder}")
        run_.avatar = load_avatar(finished, run_.avatar.body)
        return
    if name == "refine" or settings.trainer.fast_dev_run or is_helper():
        _train_stage(run_, name)
        return
    # what follows the optimisation does not change it: variants whose plans agree on it share it
    curve = (
        settings.evaluation.curve,
        settings.evaluation.curve_images,
        settings.evaluation.curve_first_second,
    )
    identity = {"settings": optim_hash(run_.plan.settings), "data": run_.data_hash, "curve": curve}
    shared = shared_folder(run_.folder, settings.shared_dir, name, identity)
    with sole_maker(shared, name):
        if take(shared, folder) is not None and finished.is_file():
            print(f"{name}: trained before, taken from {shared}")
            run_.avatar = load_avatar(finished, run_.avatar.body)
            write_gaussians_ply(run_.folder / "point_cloud.ply", run_.avatar.gaussians)
            _copy_tables(folder, run_.folder)
            return
        _train_stage(run_, name)
        _copy_tables(run_.folder, folder)
        offer(shared, folder, folder / "stage.json", without=("last.ckpt",))


def _copy_tables(source: Path, target: Path) -> None:
    for table in TABLES:
        if (source / table).is_file():
            shutil.copyfile(source / table, target / table)


def _train_stage(run_: Run, name: str) -> None:
    settings, folder = run_.settings, run_.folder / name
    _warm_up(run_, name)
    stage, seconds_before = _optim_stage(run_) if name == "optim" else _refine_stage(run_)
    guard = SignalGuard()
    callbacks: list[L.Callback] = [guard, SharedDensification()]
    checkpoint = None if settings.trainer.fast_dev_run else resumable(folder / "last.ckpt")
    logs = _logs(run_, name, checkpoint)
    callbacks += logs.callbacks  # before checkpoints
    if not settings.trainer.fast_dev_run:
        callbacks.append(Checkpointing(folder / "last.ckpt", settings.trainer.checkpoint_every))
    if settings.evaluation.curve and not is_helper():
        callbacks.append(_curve(run_))
    if settings.trainer.enable_progress_bar and not is_helper():
        callbacks.append(ProgressLine())
    tell_helpers(run_.folder)
    own: AvatarSettings = getattr(settings, name)
    trainer = _trainer(settings, own.steps, callbacks, logs)
    if name == "optim" and settings.optim.observed_colors and checkpoint is None:
        stage.clock.restore(start_as_observed(run_.avatar, run_.data, run_.renderer))
    run_.avatar.train()
    with guard:
        trainer.fit(stage, datamodule=run_.data, ckpt_path=checkpoint, weights_only=True)
    if guard.received is not None and trainer.global_step < trainer.max_steps:
        raise Interrupted(guard.received, str(folder / "last.ckpt"))
    if not is_helper():
        _hand_over(run_, folder, seconds_before + stage.clock.seconds, trainer.global_step)


def _optim_stage(run_: Run) -> tuple[AvatarStage, float]:
    settings = run_.plan.settings
    stage = OptimStage(
        run_.avatar,
        settings.optim,
        perceptual=run_.training_metric if settings.optim.lambda_lpips else None,
        densifier=_make_densifier(settings.optim, settings.optim.lambda_rgb),
        distiller=_make_distiller(run_),
        uncertain=_uncertain_masks(run_),
        renderer=run_.renderer,
        seed=settings.seed,
    )
    return stage, 0.0


def _uncertain_masks(run_: Run) -> UncertainMasks:
    """Returns where complete masks may be wrong, where the video was asked."""
    found = {observed_frame.index: observed_frame.evidence for observed_frame in run_.observed_frames or ()}
    hidden = {frame: own.maybe_hidden for frame, own in found.items() if own.maybe_hidden.any()}
    assumed_background = {frame: mask & found[frame].background for frame, mask in hidden.items()}
    return UncertainMasks(hidden, assumed_background)


def _refine_stage(run_: Run) -> tuple[AvatarStage, float]:
    """Returns the stage, its references made, and the seconds that they took."""
    settings = run_.plan.settings
    refine = settings.refine
    assert run_.observed_frames is not None
    identity = {"data": run_.data_hash, "avatar": file_digest(run_.folder / "optim" / "avatar.safetensors")}
    references, seconds = make_references(
        settings,
        run_.folder,
        run_.data,
        run_.avatar,
        run_.observed_frames,
        identity,
        run_.renderer,
        device_of(settings),
    )
    uncertain = _uncertain_masks(run_)
    uncertain_frames = [
        k for k, observed_frame in enumerate(run_.observed_frames) if observed_frame.index in uncertain.hidden
    ]
    frames = (run_.data.train_frame(k, truth=False) for k in uncertain_frames)
    is_held = refine.hidden.target == "outline" and refine.hidden.effective_weight > 0
    outlines = own_outlines(run_.avatar, frames, run_.renderer) if is_held else {}
    run_.avatar.gaussians.allocate_bands(planning.refined_sh_degree(settings))
    stage = RefineStage(
        run_.avatar,
        refine,
        references,
        uncertain,
        outlines,
        perceptual=run_.training_metric if refine.lambda_lpips else None,
        densifier=_make_densifier(refine, refine.lambda_rgb),
        renderer=run_.renderer,
        seed=settings.seed,
        steps_before=planning.steps_of(settings, settings.optim),
    )
    return stage, seconds


def _warm_up(run_: Run, stage: str) -> None:
    """Compiles what the first step would wait for, so that the first run on a machine trains no longer than others."""
    started = time.perf_counter()
    run_.renderer.warm_up()
    seconds = time.perf_counter() - started
    if seconds >= WARM_UP_SAID:
        print(
            f"{stage}: rasteriser {run_.renderer.backend} ready after {seconds:.1f} s, before the training clock starts"
        )


def _make_densifier(settings: AvatarSettings, lambda_rgb: float) -> Densifier | None:
    # the threshold belongs to a loss whose colour term has weight 1
    return Densifier(settings.densification, loss_scale=lambda_rgb or 1.0) if settings.densify else None


def _make_distiller(run_: Run) -> Distiller[Any] | None:
    """Returns score distillation, its prior loaded, where the plan has a term of it."""
    settings = run_.plan.settings
    if not settings.optim.sds.is_used:
        return None
    assert run_.observed_frames is not None
    return Distiller(
        make_score_prior(asdict(settings.prior), device_of(settings)),
        settings.optim.sds,
        steps=settings.optim.steps,
        observed_frames=run_.observed_frames,
        body=run_.avatar.body,
        renderer=run_.renderer,
        seed=settings.seed,
    )


def _hand_over(run_: Run, folder: Path, seconds: float, steps: int) -> None:
    """Writes what later stages and users take from a finished stage; the record comes last, for it says "done"."""
    avatar, pose = run_.avatar.eval(), run_.data.pose(run_.data.train_indices[0])
    folder.mkdir(parents=True, exist_ok=True)
    save_avatar(folder / "avatar.safetensors", avatar)
    write_gaussians_ply(run_.folder / "point_cloud.ply", avatar.gaussians)
    first_pose = {"betas": pose.betas.tolist(), "body_pose": pose.body_pose.tolist()}
    write_json(folder / "stage.json", {"train_seconds": seconds, "steps": steps, "first_pose": first_pose})


def _trainer(settings: Settings, steps: int, callbacks: list[L.Callback], logs: Logs) -> L.Trainer:
    trainer = settings.trainer
    return L.Trainer(
        accelerator=trainer.accelerator,
        devices=trainer.devices,
        max_steps=trainer.max_steps or steps,
        max_epochs=-1,
        max_time=trainer.max_time,
        fast_dev_run=trainer.fast_dev_run,
        logger=logs.loggers or False,
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=trainer.enable_progress_bar and not is_helper(),
        callbacks=callbacks,
        **trainer_options(trainer.devices),
    )


def _logs(run_: Run, name: str, checkpoint: Path | None) -> Logs:
    """Returns what logs a stage; one process alone does."""
    if is_helper():
        return Logs([], [])

    def views() -> dict[str, Frame]:
        found = {"training": run_.data.spread_train_frames(1), "held_out": run_.data.spread_test_frames(1)}
        return {name: frames[0] for name, frames in found.items() if frames}

    settings = run_.settings
    place = Place(run_.folder, name, checkpoint, is_trial=settings.trainer.fast_dev_run)
    return make_logs(settings.logger, place, asdict(settings), Pictured(views, run_.render))


def _curve(run_: Run) -> ErrorCurve:
    evaluation = run_.settings.evaluation
    frames = run_.data.spread_test_frames(evaluation.curve_images)
    perceptual = evaluation_metric(evaluation, run_.perceptual)
    path = run_.folder / CURVE_TABLE
    return ErrorCurve(path, frames, run_.render, evaluation.curve_first_second, perceptual)
