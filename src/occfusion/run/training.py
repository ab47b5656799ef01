"""Training by Lightning: any stage from where a stopped call left off, and what the stages of an avatar share."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.loggers import Logger

from occfusion.cpu.processes import is_helper, tell_helpers
from occfusion.data.module import HumanDataModule
from occfusion.data.sampling import spread
from occfusion.errors import ConfigError, DataError
from occfusion.files.atomic import write_json
from occfusion.files.digest import digest
from occfusion.files.run_folder import RunFolder, StageFolder
from occfusion.geometry.normals import vertex_normals
from occfusion.human import Avatar, save_avatar, write_gaussians_ply
from occfusion.human.body import Body
from occfusion.human.densify import Densifier
from occfusion.human.kernels import compile_kernels
from occfusion.human.observability import ObservedSurface
from occfusion.human.rendering import Renderer
from occfusion.human.virtual_views import VIEWS, VirtualViews
from occfusion.inpaint.accumulation import Accumulated, accumulate, sharpened
from occfusion.inpaint.completion import ColorCompleter, write_completion
from occfusion.observation.frames import ObservedFrames
from occfusion.perceptual import PerceptualMetric
from occfusion.run.environment import accelerator_of
from occfusion.settings.schema import Settings
from occfusion.settings.stages import AvatarSettings
from occfusion.stages.avatar import AvatarStage
from occfusion.stages.base import Stage
from occfusion.stages.checkpointing import Checkpointing, resumable
from occfusion.stages.curve import ErrorCurve
from occfusion.stages.interruption import Interrupted, SignalGuard
from occfusion.stages.loggers import Pictured, make_logs
from occfusion.stages.parallel import AvatarDDP, SharedDensification
from occfusion.stages.progress import ProgressLine
from occfusion.stages.surface import SurfacePrior
from occfusion.stages.targets import UncertainMasks
from occfusion.types import Camera, Frame, Pose, Truth

LOOKED_AT = 120
"""Frames at most that say what colours Gaussians start with, and how fast they learn."""
SHARPENED_FROM = 40
"""Frames at most that say what accumulated colours lack."""
WARM_UP_SAID = 0.05
"""Seconds from which on the user is told of the rasteriser's warming up."""


@dataclass(frozen=True)
class Fitted:
    """How the training of a stage ended, with all its steps done or its time over.

    Attributes:
        steps: done.
        signal: that came too late to stop a step; None: none did.
        place: of what the same command continues from.
    """

    steps: int
    signal: int | None
    place: Path

    def stop_if_asked(self) -> None:
        """Stops for that signal; called when what the stage made is handed over.

        Raises:
            Interrupted: the same command continues behind this stage.
        """
        if self.signal is not None:
            raise Interrupted(self.signal, str(self.place))


def fit(
    stage: Stage,
    batches: L.LightningDataModule | Iterable[Any],
    settings: Settings,
    folder: RunFolder,
    checkpoint: Path,
    *,
    steps: int,
    devices: int = 1,
    measuring: Sequence[L.Callback] = (),
    watching: Sequence[L.Callback] = (),
    pictured: Pictured | None = None,
) -> Fitted:
    """Trains a stage; returns how that ended.

    Args:
        stage: what is trained, in place.
        batches: what it is trained on.
        settings: of the run: its trainer and its logger.
        folder: of the run.
        checkpoint: continued from where there is one, and written.
        steps: of the stage, unless `trainer.max_steps` has another number.
        devices: processes that train together.
        measuring: callbacks that measure; they come before a checkpoint is written.
        watching: callbacks that come after all others.
        pictured: what loggers get pictures of; None: there are none.

    Raises:
        Interrupted: a signal stopped it; the same command continues.
        CheckpointError: the checkpoint is damaged.
        DataError: what it trains on ended early.
    """
    chosen, guard = settings.trainer, SignalGuard()
    loggers, logging = list[Logger](), list[L.Callback]()
    earlier = None if chosen.fast_dev_run else resumable(checkpoint, stage)
    progress = chosen.enable_progress_bar and not is_helper()
    if not is_helper():  # one process alone logs
        loggers, logging = make_logs(settings, folder, stage.name, earlier, pictured)
    callbacks: list[L.Callback] = [guard, SharedDensification(), *logging, *measuring]
    if not chosen.fast_dev_run:
        callbacks.append(Checkpointing(checkpoint, chosen.checkpoint_every))
    if progress:
        callbacks.append(ProgressLine())
    callbacks += watching
    trainer = L.Trainer(
        accelerator=accelerator_of(settings),
        devices=devices,
        strategy="auto" if devices == 1 else AvatarDDP(),
        max_steps=chosen.max_steps or steps,
        max_epochs=-1,
        max_time=chosen.max_time,
        fast_dev_run=chosen.fast_dev_run,
        logger=loggers or False,
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=progress,
        callbacks=callbacks,
    )
    with guard:
        trainer.fit(stage, batches, ckpt_path=earlier, weights_only=True)
    if guard.received is not None and trainer.global_step < trainer.max_steps:
        raise Interrupted(guard.received, str(checkpoint))
    if trainer.global_step < trainer.max_steps and not chosen.fast_dev_run:
        _tell_early_end(stage.name, trainer.global_step, int(trainer.max_steps), chosen.max_time)
    return Fitted(trainer.global_step, guard.received, checkpoint)


def _tell_early_end(name: str, steps: int, wanted: int, max_time: str | None) -> None:
    if max_time is None:  # Lightning ends without a word where there is nothing to train on
        raise DataError(f"stage {name}: what it trains on ended after {steps} of {wanted} steps")
    if not is_helper():
        ended = f"trainer.max_time={max_time} ended it after {steps} of {wanted} steps"
        print(f"{name}: {ended}; rates and schedules had not come to their ends")


@dataclass(frozen=True)
class AvatarTraining:
    """What the stages of a run share.

    Attributes:
        settings: as the user asked.
        planned: those that training goes by.
        folder: of the run.
        data: the training and held-out frames.
        body: of the frames.
        data_hash: of all that is trained on.
        held_out_hash: of all that is only measured on, for the error curve.
        observed_frames: what masks and poses say of the training frames; empty where nothing depends on it.
        uncertain: where complete masks may be wrong.
        surface: what the video says of the body's surface; None where nothing depends on it.
        metric: of the perceptual loss term; None where no stage has it.
        evaluation_metric: of the error curve; None where it has no perceptual figure.
        renderer: draws avatars.
        aligned: frames between knots of the alignment that the poses of the observed frames have; 0: none, as given.
        watching: callbacks that come last, for whoever looks at the training from outside.
    """

    settings: Settings
    planned: Settings
    folder: RunFolder
    data: HumanDataModule
    body: Body
    data_hash: str
    held_out_hash: str
    observed_frames: ObservedFrames
    uncertain: UncertainMasks
    surface: ObservedSurface | None
    metric: PerceptualMetric | None
    evaluation_metric: PerceptualMetric | None
    renderer: Renderer
    aligned: float
    watching: Sequence[L.Callback] = ()

    def warm_up(self, name: str) -> None:
        """Compiles what the first step would wait for, so that a machine's first run trains no longer than others."""
        started = time.perf_counter()
        compile_kernels(self.renderer)
        seconds = time.perf_counter() - started
        if seconds >= WARM_UP_SAID:
            ready = f"rasteriser {self.renderer.backend} ready after {seconds:.1f} s"
            print(f"{name}: {ready}, before the training clock starts")

    def shared(self, settings: AvatarSettings, surface: SurfacePrior | None) -> dict[str, Any]:
        """Returns what every `AvatarStage` takes besides avatar and settings."""
        densifier = None
        if settings.densify:  # its threshold belongs to a loss whose colour term has weight 1
            densifier = Densifier(settings.densification, loss_scale=settings.lambda_rgb or 1.0)
        return {
            "perceptual": self.metric if settings.lambda_lpips else None,
            "densifier": densifier,
            "renderer": self.renderer,
            "seed": self.settings.seed,
            "surface": surface,
        }

    def surface_prior(self, settings: AvatarSettings, avatar: Avatar) -> SurfacePrior | None:
        """Returns what closes an avatar's surface in a stage; None where the plan leaves that out."""
        chosen, observed = settings.surface, self.surface
        if not chosen.is_used or observed is None:
            return None
        vertices, faces = avatar.da_vertices.double().cpu().numpy(), avatar.body.faces.cpu().numpy()
        normals = vertex_normals(vertices, faces)
        return SurfacePrior(
            observed.known,
            normals,
            observed.thickness,
            self.virtual_views if chosen.are_views_used else [],
            chosen,
            renderer=self.renderer,
            seed=self.settings.seed,
        )

    @cached_property
    def virtual_views(self) -> VirtualViews:
        """The person of the training frames from other sides, for both stages; in every second view limbs are spread.

        In poses of the video a surface is stretched as people will see it; spread limbs hide nothing of it.
        """
        assert self.surface is not None
        frames, (camera,) = self.data.train_indices, self.data.train_cameras
        limbs = self.body.da_pose().body_pose

        def posed(number: int) -> tuple[Pose, Camera]:
            frame = frames[number * len(frames) // VIEWS]
            pose = self.data.pose(frame)
            pose = replace(pose, body_pose=limbs.to(pose.body_pose)) if number % 2 else pose
            return pose, self.data.camera_at(frame, camera)

        known, thickness = self.surface.known, self.surface.thickness
        return VirtualViews(VIEWS, posed, self.body, known, thickness, self.renderer.device)

    def accumulate(self, avatar: Avatar, most: int, opacity: float | None = None) -> Accumulated:
        """Returns what the training frames, evenly chosen at most so many, show of an avatar's Gaussians.

        Of a person who does not turn, whose surface is therefore closed, what shines through does not count.

        Args:
            avatar: set to evaluation.
            most: frames.
            opacity: of all Gaussians; None: their own.
        """
        positions = spread(len(self.data.train_indices), most)
        frames = (self.data.train_frame(k, truth=False) for k in positions)
        is_closed = any(stage.surface.is_used for stage in (self.planned.optim, self.planned.refine))
        return accumulate(avatar.eval(), frames, self.renderer, opacity, through=not is_closed)

    def complete(self, avatar: Avatar, accumulated: Accumulated, *, is_trained: bool = False) -> Accumulated:
        """Returns what the video shows of the Gaussians, with the colours of the rest completed where the plan says so.

        The completed colours of the body stay in the run folder.

        Args:
            avatar: on the body.
            accumulated: of its Gaussians.
            is_trained: whether it draws the video well enough to say what detail the accumulated colours lack.
        """
        if self.planned.optim.unseen_colors != "prior":
            return accumulated
        if is_trained:
            positions = spread(len(self.data.train_indices), SHARPENED_FROM)
            accumulated = sharpened(
                avatar.eval(),
                lambda: (self.data.train_frame(k, truth=False) for k in positions),
                self.renderer,
                accumulated,
            )
        completer = ColorCompleter(avatar.body, self.planned.prior.completion, self.renderer.device)
        completed, completion = completer.of_avatar(avatar, accumulated)
        write_completion(self.folder.completion, self.folder.completion_picture, completion, completer.body)
        return completed

    def train(self, stage: AvatarStage, steps: int, *, seconds_before: float) -> None:
        """Trains a stage and writes what later stages and users take of it.

        Args:
            stage: with the avatar, which is trained in place.
            steps: of the stage.
            seconds_before: of training that preceded it.

        Raises:
            Interrupted: a signal stopped it; the same command continues.
        """
        settings, data, avatar, own = self.settings, self.data, stage.avatar, self.folder.stage(stage.name)

        render = partial(self.renderer.frame, avatar)

        def views() -> Mapping[str, Frame]:
            found = {"training": data.spread_train_frames(1), "held_out": data.spread_test_frames(1)}
            return {name: frames[0] for name, frames in found.items() if frames}

        measuring = []
        if settings.evaluation.curve and not is_helper():
            frames = data.spread_test_frames(settings.evaluation.curve_images)
            first = settings.evaluation.curve_first_second
            measuring.append(ErrorCurve(self.folder.curve, frames, render, first, self.evaluation_metric))
        tell_helpers(self.folder.path)
        avatar.train()
        done = fit(
            stage, data, settings, self.folder, own.checkpoint, steps=steps,
            devices=settings.trainer.devices, measuring=measuring, watching=self.watching,
            pictured=Pictured(views, render),
        )  # fmt: skip
        if is_helper():
            return
        save_avatar(own.avatar, avatar.eval())
        write_gaussians_ply(self.folder.point_cloud, avatar.gaussians)
        pose, seconds = data.pose(data.train_indices[0]), seconds_before + stage.clock.seconds
        first_pose = {"betas": pose.betas.tolist(), "body_pose": pose.body_pose.tolist()}
        record = {"train_seconds": seconds, "steps": done.steps, "sha256": digest(own.avatar)}
        # last, for it says "done"
        write_json(own.record, record | {"first_pose": first_pose})
        done.stop_if_asked()


def tell_damage(left: StageFolder) -> None:
    """Tells the user of what is wrong with a finished stage, before it is made again."""
    if (damage := left.damage) is not None:
        print(f"{left.path.name}: {damage}; made again from what is whole")


def training_truths(data: HumanDataModule, group: str) -> Iterator[tuple[str, Truth]]:
    """Yields names and truth of all training frames.

    Args:
        data: the training frames.
        group: of the settings whose `source=truth` asks for them.

    Raises:
        ConfigError: the data set does not know what is hidden.
    """
    for frame in data.train_frames():
        if frame.truth is None:
            raise ConfigError(
                f"{group}.source=truth: this data set does not know what is hidden in {frame.name}; use "
                f"{group}.source=prior"
            )
        yield frame.name, frame.truth
