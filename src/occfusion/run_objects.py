"""The objects of a run, composed from its settings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from occfusion import plan as planning
from occfusion.compose import make_body, make_data
from occfusion.config import Settings, stages_to_run
from occfusion.data.module import HumanDataModule
from occfusion.files.atomic import write_json
from occfusion.human import Avatar, Body, Gaussians, PoseSpline
from occfusion.init_run import look_at_training_frames
from occfusion.inpaint.registry import check_inpainter
from occfusion.needs import (
    Decision,
    as_planned,
    may_leave_out_networks,
    registration_decision,
    with_everything,
)
from occfusion.perceptual import PerceptualMetric, load_perceptual, training_dtype
from occfusion.priors.key_light import KeyLight, find_key_light
from occfusion.priors.moments import Moment
from occfusion.priors.registry import check_score_prior
from occfusion.processes import is_helper, local_rank
from occfusion.render import render_frame
from occfusion.runfolder import claim_run_folder
from occfusion.splat import resolve_backend
from occfusion.types import Frame, Rendering


@dataclass
class Run:
    """The objects of one run.

    Attributes:
        settings: typed and checked.
        folder: the run folder, claimed.
        data: the training and held-out frames.
        avatar: as far as it is trained.
        perceptual: the perceptual metric, None where neither training nor evaluation asks for it.
        backend: of the rasteriser.
        moments: what masks and poses say of the training frames; None where nothing depends on it.
        data_hash: of all that is read.
        stages: those that will run, in order: what the scene does not need is left out.
    """

    settings: Settings
    folder: Path
    data: HumanDataModule
    avatar: Avatar
    perceptual: PerceptualMetric | None
    backend: str
    moments: list[Moment] | None
    data_hash: str
    stages: list[str]

    @property
    def training_metric(self) -> PerceptualMetric | None:
        """The perceptual metric of a loss term, in the precision that is asked for."""
        dtype = training_dtype(self.settings.perceptual.precision, device_of(self.settings))
        return None if self.perceptual is None else self.perceptual.with_dtype(dtype)

    def render(self, frame: Frame) -> Rendering:
        """Returns the avatar as the frame's camera sees it."""
        return render_frame(self.avatar, frame, self.backend)


def compose_run(settings: Settings, folder_chosen_by_user: bool) -> Run:
    """Returns the objects of a run, its data checked and its folder claimed; writes the plan.

    Raises:
        OccfusionError: anything that the user can mend.
    """
    body = make_body(settings.body)
    data = make_data(settings, body)
    data.validate()
    registered = data.register(body.faces.cpu().numpy()) if settings.registration == "auto" else None
    summary = data.summary()
    print("\n".join(["data taken", *(f"  {line}" for line in data.taken.lines())]))
    backend = resolve_backend(settings.rasterizer.name, device_of(settings), torch.float32)
    is_prior_asked = "init" in settings.variant.stages or settings.optim.sds.is_used
    is_hidden_weighed = settings.optim.mask_hidden < 1.0
    are_frames_judged = (
        is_prior_asked or may_leave_out_networks(settings) or is_hidden_weighed or settings.optim.key_light
    )
    moments = look_at_training_frames(data, body) if are_frames_judged else None
    key_light = None
    if moments is not None and settings.optim.key_light:
        key_light = find_key_light(
            lambda k: data.train_frame(k, truth=False), moments, body.faces.cpu().numpy()
        )
    if moments is not None and settings.plan == "full":
        moments = with_everything(moments)
    decisions = [registration_decision(registered)]
    decisions += planning.make_plan(settings, summary, backend, moments, key_light)
    decisions += planning.precision_decisions(settings, decisions, device_of(settings))
    _check_priors(settings, decisions)
    folder = claim_run_folder(
        settings, summary["hash"], chosen_by_user=folder_chosen_by_user, data=summary["taken"]
    )
    if decisions[0].used:
        print(f"{decisions[0].part}: {decisions[0].reason}")
    if not is_helper():
        write_json(folder / "plan.json", planning.plan_json(decisions) | {"scene": summary})
    stages = [
        stage for stage in stages_to_run(settings) if f"stage {stage}" not in planning.left_out(decisions)
    ]
    for stage in stages_to_run(settings):
        if stage not in stages:
            print(f"{stage}: left out, no frame is occluded")
    if not is_helper():
        data.store_occlusion(folder / "occlusion")
    perceptual = None
    trained = [getattr(settings, stage) for stage in stages if stage != "init"]
    if settings.evaluation.perceptual or any(stage.lambda_lpips for stage in trained):
        perceptual = load_perceptual(settings.perceptual.name, settings.perceptual.vgg_path)
    optim = as_planned(settings, moments).optim
    sh_degree = planning.reached_sh_degree(settings)
    avatar = Avatar(
        body,
        sh_degree=sh_degree,
        refine_pose=optim.refine_pose,
        pose_spline=PoseSpline.over(data.train_indices, optim.pose_knots) if optim.pose_knots else None,
        learn_skinning=optim.learn_skinning,
        skinning_every=optim.skinning_every,
        sh_frame=optim.sh_frame,
        key_light=_vector(key_light, body) if "key light" not in planning.left_out(decisions) else None,
        dilation=optim.dilation,
        gaussians=Gaussians.on_body(body, sh_degree, optim.gaussians, optim.thickness),
    )
    return Run(settings, folder, data, avatar, perceptual, backend, moments, summary["hash"], stages)


def _vector(key_light: KeyLight | None, body: Body) -> Tensor | None:
    return None if key_light is None else torch.from_numpy(key_light.vector).to(body.v_template)


def _check_priors(settings: Settings, decisions: list[Decision]) -> None:
    """Refuses a run whose networks cannot be loaded, before any training; those that it does not need may be absent.

    Raises:
        ConfigError: weights or packages are missing.
    """
    used = {decision.part for decision in decisions if decision.used}
    stages = stages_to_run(settings)
    if "optim" in stages and used & {"loss term sds_pose", "loss term sds_can"}:
        check_score_prior(settings.prior)
    if "refine" in stages and settings.refine.source == "prior" and "inpainting" in used:
        check_inpainter(settings.prior, device_of(settings))


def device_of(settings: Settings) -> torch.device:
    """Returns where a run computes."""
    accelerator = settings.trainer.accelerator
    on_gpu = accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available()
    return torch.device("cuda", local_rank()) if on_gpu else torch.device("cpu")
