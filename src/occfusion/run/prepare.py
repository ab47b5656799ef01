"""The first steps of a run: what the data show, what the scene needs of the method, and the objects for that."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from occfusion.cpu.memory import return_memory
from occfusion.cpu.processes import is_helper, local_rank
from occfusion.data.module import HumanDataModule
from occfusion.data.sampling import spread
from occfusion.data.scene_registration import SceneRegistration
from occfusion.files.atomic import write_json
from occfusion.files.run_folder import RunFolder
from occfusion.human import Avatar, Body, Gaussians, PoseSpline
from occfusion.human.coverage import BodyCoverage, cover_body, sighting_of
from occfusion.human.observability import ObservedSurface, observe_surface
from occfusion.human.rendering import Renderer
from occfusion.inpaint.build_inpainter import check_inpainter
from occfusion.inpaint.completion_net import check_completion_net
from occfusion.observation.clothes import CLOTHES_VIEWS, measure_clothes
from occfusion.observation.frames import ObservedFrames, observe_frames
from occfusion.observation.light import Light, observe_light
from occfusion.observation.pose_alignment import Alignment, aligned_pose
from occfusion.observation.pose_witness import Look
from occfusion.observation.sequence_alignment import align_sequence
from occfusion.perceptual import load_perceptual, training_dtype
from occfusion.plan.decisions import is_alignment_asked, is_surface_open, may_leave_out_networks
from occfusion.plan.hidden import with_everything
from occfusion.plan.make import Plan, make_plan, reached_sh_degree
from occfusion.priors.build_prior import check_score_prior
from occfusion.run.bodies import make_body, make_data
from occfusion.run.environment import accelerator_of
from occfusion.run.evaluation import evaluation_metric
from occfusion.run.folder import claim_run_folder
from occfusion.run.init import complete_masks
from occfusion.run.optim import optimise
from occfusion.run.refine import refine
from occfusion.run.training import AvatarTraining
from occfusion.settings.schema import Settings
from occfusion.stages.init import frames_to_complete
from occfusion.stages.targets import UncertainMasks
from occfusion.types import Frame

COVERAGE_VIEWS = 200
"""Training views that the body is held against at most, evenly spread; at 256 px a view takes about 4 ms."""


@dataclass(frozen=True)
class Observed:
    """What a data folder shows and the machine offers, before anything is decided.

    Attributes:
        body: of the data.
        data: the training and held-out frames, checked; cameras are corrected where that is certain.
        summary: what was selected and found.
        registered: whether pictures lie where the cameras say; None where that is not to be measured.
        frames: what masks and poses say of the training frames; None where nothing depends on it.
        light: what the training frames tell of lamp and exposure; None where nothing depends on it.
        coverage: how well the training frames show the body, place by place; None where no view does.
        surface: what they say of its surface; None where no view shows it or nothing depends on it.
        renderer: draws avatars, on the device where the run computes.
        alignment: what outlines say of the poses; None where they tell too little or were not asked.
    """

    body: Body
    data: HumanDataModule
    summary: dict[str, Any]
    registered: SceneRegistration | None
    frames: ObservedFrames | None
    light: Light | None
    coverage: BodyCoverage | None
    surface: ObservedSurface | None
    renderer: Renderer
    alignment: Alignment | None

    @property
    def data_hash(self) -> str:
        """The hash of all that is trained on."""
        return str(self.summary["hash"])

    @property
    def held_out_hash(self) -> str:
        """The hash of all that is only measured on."""
        return str(self.summary["held_out_hash"])


RUN_STAGE = {"init": complete_masks, "optim": optimise, "refine": refine}


def run_stage(name: str, training: AvatarTraining, avatar: Avatar) -> Avatar:
    """Returns the avatar as a stage leaves it, where the run draws; what is done already is taken over.

    Raises:
        Interrupted: a signal stopped it; the same command continues.
    """
    device = training.renderer.device
    return RUN_STAGE[name](training, avatar.to(device)).to(device)  # Lightning leaves it on the host


@dataclass(frozen=True)
class Run:
    """The objects of one run.

    Attributes:
        plan: what the scene needs of the settings.
        avatar: untrained.
        training: what its stages share.
        coverage: how well the training views show the body; None where no view does.
    """

    plan: Plan
    avatar: Avatar
    training: AvatarTraining
    coverage: BodyCoverage | None

    def run_stages(self) -> Avatar:
        """Returns the avatar of the last stage; where none trains it, as it was built.

        Raises:
            Interrupted: a signal stopped it; the same command continues.
        """
        avatar = self.avatar
        for stage in self.plan.stages:
            return_memory()  # what was observed, or trained, took some for a while
            avatar = run_stage(stage, self.training, avatar)
        return_memory()
        return avatar


# --- observe -----------------------------------------------------------------------------------------------


def observe(settings: Settings) -> Observed:
    """Opens the data and returns what they show, as far as the settings leave anything to decide by it.

    Raises:
        OccfusionError: anything about the data that the user can mend.
    """
    body = make_body(settings.body)
    data = make_data(settings, body)
    data.validate()
    faces, optim = body.faces.cpu().numpy(), settings.optim
    registered, alignment = _register_and_align(settings, data, body)
    read = _aligned_reader(data, body, alignment)
    is_prior_asked = "init" in settings.variant.stages or optim.sds.is_used
    is_closed = optim.surface.is_used or settings.refine.surface.is_used
    are_judged = (
        is_closed
        or is_prior_asked
        or may_leave_out_networks(settings)
        or optim.hidden.effective_weight < 1.0
        or optim.key_light
        or settings.exposure == "auto"
    )
    observed_frames = observe_training_frames(data, body, read) if are_judged else None
    light = None
    if observed_frames is not None and (optim.key_light or settings.exposure == "auto"):
        light = observe_light(read, observed_frames, faces, even=settings.exposure == "auto")
        if light.gains is not None:
            data.even_exposure(light.gains)
    if observed_frames is not None and settings.plan == "full":
        observed_frames = with_everything(observed_frames)
    views = spread(len(data.train_indices), COVERAGE_VIEWS)
    coverage = cover_body((sighting_of(read(k), body) for k in views), body)
    surface = None
    if is_closed and coverage is not None and observed_frames is not None:
        surface = _observe_surface(settings, data, body, coverage, observed_frames)
    return Observed(
        body, data, data.summary(), registered, observed_frames, light, coverage, surface,
        make_renderer(settings), alignment,
    )  # fmt: skip


def make_renderer(settings: Settings) -> Renderer:
    """Returns what draws in a run, on the device that it trains on."""
    name = accelerator_of(settings)
    device = torch.device(name, local_rank()) if name == "cuda" else torch.device(name)
    return Renderer(settings.rasterizer.name, device)


def _register_and_align(
    settings: Settings, data: HumanDataModule, body: Body
) -> tuple[SceneRegistration | None, Alignment | None]:
    """Returns whether pictures lie where cameras say, and what outlines say of poses; cameras are corrected.

    Each may be mistaken for the other. A shift that is certain whatever the poses are is taken out of the cameras, and
    poses are aligned behind it; so is one that is certain where outlines do not say that poses are off. Another one
    takes held-out cameras to confirm it.
    """

    def align(*, registered: bool) -> Alignment | None:
        def look_at(position: int) -> Look:
            return Look.at(data.train_frame(position, truth=False))

        knots = settings.optim.pose_knots
        return align_sequence(look_at, data.train_indices, body, knots, registered=registered)

    is_off = settings.registration == "off"
    alignment = align(registered=is_off) if is_alignment_asked(settings) else None
    if is_off:
        return None, alignment
    may_explain = alignment is not None and alignment.is_taken and not alignment.shows_shift
    registered = data.register(body.faces.cpu().numpy(), poses_may_explain=may_explain)
    if alignment is not None and registered.corrections:
        alignment = align(registered=True)
    return registered, alignment


def _aligned_reader(data: HumanDataModule, body: Body, alignment: Alignment | None) -> Callable[[int], Frame]:
    """Returns what reads a training frame by its position, its pose aligned, without the truth."""
    spline = alignment.spline() if alignment is not None and alignment.is_taken else None

    def read(position: int) -> Frame:
        frame = data.train_frame(position, truth=False)
        return frame if spline is None else replace(frame, pose=aligned_pose(frame.pose, spline, body))

    return read


def _observe_surface(
    settings: Settings,
    data: HumanDataModule,
    body: Body,
    coverage: BodyCoverage,
    observed_frames: ObservedFrames,
) -> ObservedSurface:
    vertices, faces = body.da_vertices().cpu().numpy(), body.faces.cpu().numpy()
    known = observe_surface(coverage.coverage, vertices, faces)
    ignorance, turn = (
        float(np.average(of, weights=coverage.areas)) for of in (known.ignorance, known.turns())
    )
    thickness = np.zeros(len(vertices))
    if is_surface_open(settings, turn):
        looks = spread(len(observed_frames), CLOTHES_VIEWS)
        thickness = measure_clothes(observed_frames, partial(data.train_frame, truth=False), body, looks)
    return ObservedSurface(known, ignorance, turn, thickness)


def observe_training_frames(
    data: HumanDataModule, body: Body, read: Callable[[int], Frame] | None = None
) -> ObservedFrames:
    """Returns what masks and poses say of the training frames, as `read` gives them, or as the data do."""
    read = _aligned_reader(data, body, None) if read is None else read
    return observe_frames(read, data.train_indices, body)


# --- decide ------------------------------------------------------------------------------------------------


def decide(settings: Settings, observed: Observed) -> Plan:
    """Returns what the scene needs; the networks that it needs are there.

    Raises:
        ConfigError: weights or packages of such a network are missing; those of others may be absent.
    """
    renderer = observed.renderer
    plan = make_plan(
        settings, observed.summary, renderer.backend, observed.frames, observed.light, observed.registered,
        observed.surface, observed.coverage, renderer.device, observed.alignment,
    )  # fmt: skip
    planned = plan.settings
    if {"optim", "refine"} & set(plan.stages) and planned.optim.unseen_colors == "prior":
        check_completion_net(planned.prior.completion.weights)  # small: loaded to see that it can be
    if "optim" in plan.stages and planned.optim.sds.is_used:
        check_score_prior(asdict(planned.prior))
    if "refine" in plan.stages and planned.refine.references.source == "prior" and plan.inpaints:
        check_inpainter(asdict(planned.prior), renderer.device)
    return plan


def claim(
    settings: Settings,
    observed: Observed,
    plan: Plan,
    *,
    folder_chosen_by_user: bool,
    idle: Sequence[str] = (),
) -> RunFolder:
    """Returns the run's own folder, with the plan in it; tells the user of both, and of settings that do nothing.

    Raises:
        ConfigError: the folder that the user named holds another run, or cannot be written.
    """
    folder = claim_run_folder(
        settings, observed.data_hash, chosen_by_user=folder_chosen_by_user, data=observed.summary["taken"]
    )
    if not is_helper():
        seen = None if observed.coverage is None else observed.coverage.json()
        write_json(folder.plan, plan.json() | {"coverage": seen, "scene": observed.summary, "idle": [*idle]})
        observed.data.store_occlusion(folder.occlusion)
        _tell("data", observed.data.taken.lines())
        if observed.coverage is not None:
            _tell("directions", [observed.coverage.text(), *observed.coverage.warnings()])
        if idle:
            _tell("settings that change nothing in this run", idle)
        _tell("plan", [*plan.lines(), f"all decisions: {folder.plan}"])
    return folder


def _tell(heading: str, lines: Sequence[str]) -> None:
    print("\n".join([heading, *(f"  {line}" for line in lines)]))


# --- build -------------------------------------------------------------------------------------------------


def build(settings: Settings, observed: Observed, plan: Plan, folder: RunFolder) -> Run:
    """Returns the objects of a run.

    Raises:
        OccfusionError: what the perceptual metric needs is missing.
    """
    trained = [getattr(settings, stage) for stage in plan.stages if stage != "init"]
    metric = evaluating = None
    if settings.evaluation.perceptual or any(stage.lambda_lpips for stage in trained):
        device = observed.renderer.device
        perceptual = load_perceptual(settings.perceptual.name, settings.perceptual.vgg_path).to(device)
        precision = training_dtype(settings.perceptual.precision, device)
        metric = perceptual.with_dtype(precision)
        evaluating = evaluation_metric(settings.evaluation, perceptual)
    frames = ObservedFrames.of([]) if observed.frames is None else observed.frames
    completed = frames_to_complete(frames, plan.settings.init.max_frames) if "init" in plan.stages else None
    alignment = observed.alignment
    training = AvatarTraining(
        settings=settings,
        planned=plan.settings,
        folder=folder,
        data=observed.data,
        body=observed.body,
        data_hash=observed.data_hash,
        held_out_hash=observed.held_out_hash,
        observed_frames=frames,
        uncertain=UncertainMasks.found(frames, None if completed is None else frozenset(completed)),
        surface=observed.surface,
        metric=metric,
        evaluation_metric=evaluating,
        renderer=observed.renderer,
        aligned=round(alignment.spacing, 6) if alignment is not None and alignment.is_taken else 0.0,
    )
    return Run(plan, _make_avatar(plan.settings, observed), training, observed.coverage)


def _make_avatar(planned: Settings, observed: Observed) -> Avatar:
    optim, body, sh_degree = planned.optim, observed.body, reached_sh_degree(planned)
    lamp, knots = None, optim.pose_knots
    if optim.key_light:
        assert (
            observed.light is not None and observed.light.key_light is not None
        )  # where it is planned, it was found
        lamp = torch.from_numpy(observed.light.key_light.vector).to(body.v_template)
    spline = PoseSpline.over(observed.data.train_indices, knots) if knots else None
    if knots and observed.alignment is not None and observed.alignment.is_taken:
        spline = observed.alignment.spline()
    surface = observed.surface if optim.surface.is_used else None
    heights = None if surface is None else surface.heights
    gaussians = Gaussians.on_body(body, sh_degree, optim.gaussians, optim.thickness, heights)
    if optim.gaussians not in (0, found := gaussians.num_gaussians):
        why = "each vertex has one" if found > optim.gaussians else "each vertex and face has one"
        _tell("Gaussians", [f"{found} at the start, though optim.gaussians={optim.gaussians}: {why}"])
    return Avatar(
        body,
        sh_degree=sh_degree,
        refine_pose=optim.refine_pose,
        pose_spline=spline,
        learn_skinning=optim.learn_skinning,
        skinning_every=optim.skinning_every,
        key_light=lamp,
        dilation=optim.dilation,
        gaussians=gaussians,
    )
