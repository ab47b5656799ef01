"""The objects of a run, composed from its settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from occfusion.cpu.processes import is_helper, local_rank
from occfusion.data.module import HumanDataModule
from occfusion.data.sampling import spread
from occfusion.data.scene_registration import SceneRegistration
from occfusion.files.atomic import write_json
from occfusion.human import Avatar, Body, Gaussians, PoseSpline
from occfusion.human.coverage import BodyCoverage, cover_body, sighting_of
from occfusion.human.rendering import Renderer
from occfusion.inpaint.build_inpainter import check_inpainter
from occfusion.observation.frames import ObservedFrame
from occfusion.observation.key_light import KeyLight, find_key_light
from occfusion.perceptual import PerceptualMetric, load_perceptual, training_dtype
from occfusion.plan.decisions import may_leave_out_networks, with_everything
from occfusion.plan.make import Plan, make_plan, reached_sh_degree
from occfusion.priors.build_prior import check_score_prior
from occfusion.run.compose import make_body, make_data
from occfusion.run.folder import claim_run_folder
from occfusion.run.masks import observe_training_frames
from occfusion.settings.schema import Settings
from occfusion.types import Frame, Rendering

COVERAGE_VIEWS = 300
"""Training views that the body is held against, evenly spread; at 256 px a view takes about 20 ms."""


@dataclass
class Run:
    """The objects of one run.

    Attributes:
        settings: as the user asked, typed and checked.
        plan: what the scene needs of them; `plan.settings` are those that training goes by.
        folder: the run folder, claimed.
        data: the training and held-out frames.
        avatar: as far as it is trained.
        perceptual: the perceptual metric, None where neither training nor evaluation asks for it.
        renderer: draws avatars.
        observed_frames: what masks and poses say of the training frames; None where nothing depends on it.
        coverage: how well the training views show the body; None where no view does.
        data_hash: of all that is read.
    """

    settings: Settings
    plan: Plan
    folder: Path
    data: HumanDataModule
    avatar: Avatar
    perceptual: PerceptualMetric | None
    renderer: Renderer
    observed_frames: list[ObservedFrame] | None
    coverage: BodyCoverage | None
    data_hash: str

    @property
    def training_metric(self) -> PerceptualMetric | None:
        """The perceptual metric of a loss term, in the precision that is asked for."""
        dtype = training_dtype(self.settings.perceptual.precision, device_of(self.settings))
        return None if self.perceptual is None else self.perceptual.with_dtype(dtype)

    def render(self, frame: Frame) -> Rendering:
        """Returns the avatar as the frame's camera sees it."""
        return self.renderer.frame(self.avatar, frame)


@dataclass(frozen=True)
class Observed:
    """What a data folder shows, before anything is decided.

    Attributes:
        summary: what was selected and found.
        registered: whether pictures lie where the cameras say; None where that is not to be measured.
        frames: what masks and poses say of the training frames; None where nothing depends on it.
        key_light: the lamp that the training frames show; None where they show none or nothing depends on it.
        coverage: how well they show the body, place by place; None where no view does.
    """

    summary: dict[str, Any]
    registered: SceneRegistration | None
    frames: list[ObservedFrame] | None
    key_light: KeyLight | None
    coverage: BodyCoverage | None


def compose_run(settings: Settings, folder_chosen_by_user: bool) -> Run:
    """Observes the data, decides what the scene needs, and builds the objects of the run; writes the plan.

    Raises:
        OccfusionError: anything that the user can mend.
    """
    body = make_body(settings.body)
    data = make_data(settings, body)
    data.validate()
    observed = observe(settings, data, body)
    device = device_of(settings)
    renderer = Renderer(settings.rasterizer.name, device)
    plan = make_plan(
        settings,
        observed.summary,
        renderer.backend,
        observed.frames,
        observed.key_light,
        observed.registered,
        device,
    )
    _check_priors(plan, device)
    folder = claim_run_folder(
        settings,
        observed.summary["hash"],
        chosen_by_user=folder_chosen_by_user,
        data=observed.summary["taken"],
    )
    if not is_helper():
        seen = None if observed.coverage is None else observed.coverage.json()
        write_json(folder / "plan.json", plan.json() | {"coverage": seen, "scene": observed.summary})
        data.store_occlusion(folder / "occlusion")
        _tell("data", data.taken.lines())
        if observed.coverage is not None:
            _tell("directions", [observed.coverage.text(), *observed.coverage.warnings()])
        _tell("plan", [*plan.lines(), f"all decisions: {folder / 'plan.json'}"])
    trained = [getattr(settings, stage) for stage in plan.stages if stage != "init"]
    perceptual = None
    if settings.evaluation.perceptual or any(stage.lambda_lpips for stage in trained):
        perceptual = load_perceptual(settings.perceptual.name, settings.perceptual.vgg_path)
    return Run(
        settings=settings,
        plan=plan,
        folder=folder,
        data=data,
        avatar=_make_avatar(plan.settings, data, body, observed.key_light),
        perceptual=perceptual,
        renderer=renderer,
        observed_frames=observed.frames,
        coverage=observed.coverage,
        data_hash=observed.summary["hash"],
    )


def observe(settings: Settings, data: HumanDataModule, body: Body) -> Observed:
    """Returns what a data folder shows, as far as the settings leave anything to decide by it.

    Args:
        settings: as the user asked.
        data: checked; its cameras are corrected where that is certain.
        body: of the data.
    """
    faces = body.faces.cpu().numpy()
    registered = data.register(faces) if settings.registration == "auto" else None
    optim = settings.optim
    is_prior_asked = "init" in settings.variant.stages or optim.sds.is_used
    are_judged = (
        is_prior_asked
        or may_leave_out_networks(settings)
        or optim.hidden.effective_weight < 1.0
        or optim.key_light
    )
    observed_frames = observe_training_frames(data, body) if are_judged else None
    key_light = None
    if observed_frames is not None and optim.key_light:
        key_light = find_key_light(lambda k: data.train_frame(k, truth=False), observed_frames, faces)
    if observed_frames is not None and settings.plan == "full":
        observed_frames = with_everything(observed_frames)
    views = spread(len(data.train_indices), COVERAGE_VIEWS)
    sightings = (sighting_of(data.train_frame(k, truth=False), body) for k in views)
    return Observed(data.summary(), registered, observed_frames, key_light, cover_body(sightings, body))


def _make_avatar(planned: Settings, data: HumanDataModule, body: Body, key_light: KeyLight | None) -> Avatar:
    optim, sh_degree = planned.optim, reached_sh_degree(planned)
    lamp = None
    if optim.key_light:
        assert key_light is not None  # the plan has one only where one was found
        lamp = torch.from_numpy(key_light.vector).to(body.v_template)
    return Avatar(
        body,
        sh_degree=sh_degree,
        refine_pose=optim.refine_pose,
        pose_spline=PoseSpline.over(data.train_indices, optim.pose_knots) if optim.pose_knots else None,
        learn_skinning=optim.learn_skinning,
        skinning_every=optim.skinning_every,
        key_light=lamp,
        dilation=optim.dilation,
        gaussians=Gaussians.on_body(body, sh_degree, optim.gaussians, optim.thickness),
    )


def _tell(heading: str, lines: Sequence[str]) -> None:
    print("\n".join([heading, *(f"  {line}" for line in lines)]))


def _check_priors(plan: Plan, device: torch.device) -> None:
    """Refuses a run whose networks cannot be loaded, before any training; those that it does not need may be absent.

    Raises:
        ConfigError: weights or packages are missing.
    """
    planned = plan.settings
    if "optim" in plan.stages and planned.optim.sds.is_used:
        check_score_prior(asdict(planned.prior))
    if "refine" in plan.stages and planned.refine.references.source == "prior" and plan.inpaints:
        check_inpainter(asdict(planned.prior), device)


def device_of(settings: Settings) -> torch.device:
    """Returns where a run computes."""
    accelerator = settings.trainer.accelerator
    on_gpu = accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available()
    return torch.device("cuda", local_rank()) if on_gpu else torch.device("cpu")
