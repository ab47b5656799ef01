"""Composes the objects of a run from its settings, runs the stages, evaluates, reports."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import torch
from omegaconf import DictConfig

from occfusion import plan as planning
from occfusion.compose import make_body, make_data
from occfusion.config import PRIOR_STAGE, Settings, load_settings, stages_to_run
from occfusion.data.handful import held_out_handful
from occfusion.data.module import HumanDataModule
from occfusion.evaluation_run import evaluate_run, evaluation_metric
from occfusion.files.atomic import write_json
from occfusion.finished import finished_in, record_finished
from occfusion.human import Avatar, load_avatar, save_avatar, write_gaussians_ply
from occfusion.human.densify import Densifier
from occfusion.init_run import look_at_training_frames, run_init
from occfusion.perceptual import PerceptualMetric, load_perceptual
from occfusion.prior_run import run_prior_training
from occfusion.priors.moments import Moment
from occfusion.priors.registry import check_score_prior, make_score_prior
from occfusion.processes import is_helper, local_rank, tell_helpers
from occfusion.render import render_frame
from occfusion.report import write_report
from occfusion.runfolder import at_work, claim_run_folder
from occfusion.splat import resolve_backend, warm_up
from occfusion.stages.checkpointing import Checkpointing, resumable
from occfusion.stages.curve import ErrorCurve
from occfusion.stages.distil import Distiller
from occfusion.stages.interruption import Interrupted, SignalGuard
from occfusion.stages.optim import OptimStage
from occfusion.stages.parallel import SharedDensification, trainer_options
from occfusion.stages.progress import ProgressLine
from occfusion.tables import print_summary
from occfusion.types import Frame, Rendering

WARM_UP_SAID = 0.05
"""Seconds from which on the user is told of the rasteriser's warming up."""


@dataclass
class Run:
    """The objects of one run."""

    settings: Settings
    folder: Path
    data: HumanDataModule
    avatar: Avatar
    perceptual: PerceptualMetric | None
    backend: str
    moments: list[Moment] | None
    data_hash: str

    def render(self, frame: Frame) -> Rendering:
        """Returns the avatar as the frame's camera sees it."""
        return render_frame(self.avatar, frame, self.backend)


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
    L.seed_everything(settings.seed, verbose=False)
    if settings.stage.name == PRIOR_STAGE:
        done = run_prior_training(settings, folder_chosen_by_user=folder_chosen_by_user)
        return Path(settings.output_dir), done
    run_ = _compose(settings, folder_chosen_by_user)
    with at_work(run_.folder):
        return _run_stages(run_)


def _run_stages(run_: Run) -> tuple[Path, dict[str, Any]]:
    """Runs the stages that are asked for, evaluates and reports; returns the folder and `metrics.json`."""
    settings = run_.settings
    if (finished := finished_in(run_.folder, settings, run_.data_hash)) is not None:
        record_finished(run_.folder, settings, run_.data_hash)  # where the files lie now
        print_summary(run_.folder, finished.metrics)
        return run_.folder, finished.metrics
    for stage in stages_to_run(settings):
        if stage == "init":
            _complete_masks(run_)
        else:
            _run_stage(run_, stage)
    if is_helper():
        return run_.folder, {}
    if stages_to_run(settings) == ["init"]:  # nothing is trained yet that could be evaluated
        print(f"run folder: {run_.folder}")
        return run_.folder, {}
    metrics = evaluate_run(
        run_.folder, run_.data, run_.render, settings, run_.perceptual,
        gaussians=run_.avatar.gaussians.num_gaussians,
    )  # fmt: skip
    write_report(run_.folder)
    record_finished(run_.folder, settings, run_.data_hash)
    print_summary(run_.folder, metrics)
    return run_.folder, metrics


def _compose(settings: Settings, folder_chosen_by_user: bool) -> Run:
    body = make_body(settings.body)
    data = make_data(settings, body)
    data.validate()
    summary = data.summary()
    backend = resolve_backend(settings.rasterizer.name, _device(settings), torch.float32)
    if settings.optim.sds.is_used and "optim" in stages_to_run(settings):
        check_score_prior(settings.prior)
    folder = claim_run_folder(settings, summary["hash"], chosen_by_user=folder_chosen_by_user)
    is_prior_asked = "init" in settings.variant.stages or settings.optim.sds.is_used
    moments = look_at_training_frames(data, body) if is_prior_asked else None
    decisions = planning.make_plan(settings, summary, backend, moments)
    if not is_helper():
        write_json(folder / "plan.json", planning.plan_json(decisions) | {"scene": summary})
    perceptual = None
    if settings.optim.lambda_lpips or settings.evaluation.perceptual:
        perceptual = load_perceptual(settings.perceptual.name, settings.perceptual.vgg_path)
    optim = settings.optim
    avatar = Avatar(
        body,
        sh_degree=planning.reached_sh_degree(settings),
        refine_pose=optim.refine_pose,
        learn_skinning=optim.learn_skinning,
        skinning_every=optim.skinning_every,
        sh_frame=optim.sh_frame,
    )
    return Run(settings, folder, data, avatar, perceptual, backend, moments, summary["hash"])


def _device(settings: Settings) -> torch.device:
    accelerator = settings.trainer.accelerator
    on_gpu = accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available()
    return torch.device("cuda", local_rank()) if on_gpu else torch.device("cpu")


def _complete_masks(run_: Run) -> None:
    """Runs the initialisation stage, unless every frame shows a whole person."""
    assert run_.moments is not None
    if not any(moment.evidence.occluded for moment in run_.moments):
        print("init: no frame is occluded; masks are taken as they are")
        return
    run_init(
        run_.settings,
        run_.folder,
        run_.data,
        run_.avatar.body,
        run_.moments,
        run_.data_hash,
        _device(run_.settings),
    )


def _run_stage(run_: Run, name: str) -> None:
    """Trains a stage, or takes its result over when it is finished already."""
    assert name == "optim"  # load_settings lets no other stage through yet
    settings, folder = run_.settings, run_.folder / name
    finished = folder / "avatar.safetensors"
    if (folder / "stage.json").is_file() and finished.is_file():
        print(f"{name}: finished before, taken from {folder}")
        run_.avatar = load_avatar(finished, run_.avatar.body)
        return
    _warm_up(run_, name)
    stage = OptimStage(
        run_.avatar,
        settings.optim,
        perceptual=run_.perceptual if settings.optim.lambda_lpips else None,
        densifier=_make_densifier(settings),
        distiller=_make_distiller(run_),
        backend=run_.backend,
        seed=settings.seed,
    )
    guard = SignalGuard()
    callbacks: list[L.Callback] = [guard, SharedDensification()]
    if not settings.trainer.fast_dev_run:
        callbacks.append(Checkpointing(folder / "last.ckpt", settings.trainer.checkpoint_every))
    if settings.evaluation.curve and not is_helper():
        callbacks.append(_curve(run_))
    if settings.trainer.enable_progress_bar and not is_helper():
        callbacks.append(ProgressLine())
    tell_helpers(run_.folder)
    trainer = _trainer(settings, settings.optim.steps, callbacks)
    checkpoint = None if settings.trainer.fast_dev_run else resumable(folder / "last.ckpt")
    with guard:
        trainer.fit(stage, datamodule=run_.data, ckpt_path=checkpoint, weights_only=True)
    if guard.received is not None and trainer.global_step < trainer.max_steps:
        raise Interrupted(guard.received, str(folder / "last.ckpt"))
    if not is_helper():
        _hand_over(run_, folder, stage.clock.seconds, trainer.global_step)


def _warm_up(run_: Run, stage: str) -> None:
    """Compiles what the first step would wait for, so that the first run on a machine trains no longer than others."""
    seconds = warm_up(run_.backend, _device(run_.settings))
    if seconds >= WARM_UP_SAID:
        print(
            f"{stage}: rasteriser {run_.backend} ready after {seconds:.1f} s, before the training clock starts"
        )


def _make_densifier(settings: Settings) -> Densifier | None:
    optim = settings.optim
    if not optim.densify:
        return None
    # the threshold belongs to a loss whose colour term has weight 1
    return Densifier(optim.densification, loss_scale=optim.lambda_rgb or 1.0)


def _make_distiller(run_: Run) -> Distiller[Any] | None:
    """Returns score distillation, its prior loaded, where the plan has a term of it."""
    settings = run_.settings
    if not any(decision.used for decision in planning.sds_decisions(settings, run_.moments)):
        return None
    assert run_.moments is not None
    return Distiller(
        make_score_prior(settings.prior, _device(settings)),
        settings.optim.sds,
        steps=settings.optim.steps,
        moments=run_.moments,
        body=run_.avatar.body,
        backend=run_.backend,
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


def _trainer(settings: Settings, steps: int, callbacks: list[L.Callback]) -> L.Trainer:
    trainer = settings.trainer
    return L.Trainer(
        accelerator=trainer.accelerator,
        devices=trainer.devices,
        max_steps=trainer.max_steps or steps,
        max_epochs=-1,
        max_time=trainer.max_time,
        fast_dev_run=trainer.fast_dev_run,
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=trainer.enable_progress_bar and not is_helper(),
        callbacks=callbacks,
        **trainer_options(trainer.devices),
    )


def _curve(run_: Run) -> ErrorCurve:
    evaluation = run_.settings.evaluation
    frames = held_out_handful(run_.data, evaluation.curve_images)
    perceptual = evaluation_metric(evaluation, run_.perceptual)
    path = run_.folder / "error_vs_time.csv"
    return ErrorCurve(path, frames, run_.render, evaluation.curve_first_second, perceptual)
