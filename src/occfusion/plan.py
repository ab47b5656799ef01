"""What a scene needs and what is left out, each with the measured reason (`plan.json`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from occfusion.config import STAGES, Settings, stages_to_run
from occfusion.priors.evidence import HIDDEN_SHARE
from occfusion.priors.moments import Moment
from occfusion.stages.avatar import BOX_PADDING
from occfusion.stages.settings import AvatarSettings

HIDDEN_STAGES = ("init",)
"""Stages that are about what is hidden alone: left out where nothing is. The refinement is not one of them: without
references it still trains on, with more Gaussians (docs/leaving_out.md has what that gains)."""

MOSTLY_HIDDEN = 0.9
"""Of the body: a frame that hides more is completed from the pose nearly alone, and its mask is not relied on."""


@dataclass(frozen=True)
class Decision:
    """One part of the system: whether it is used, and why.

    Attributes:
        part: what is decided about.
        used: whether the run does it.
        reason: the setting or measurement that decided.
    """

    part: str
    used: bool
    reason: str


def make_plan(
    settings: Settings, summary: Mapping[str, Any], backend: str, moments: Sequence[Moment] | None = None
) -> list[Decision]:
    """Returns the decisions for a run, from its settings and from what the data folder showed.

    Args:
        settings: the run's settings.
        summary: the DataModule's summary; uses `occluded_frames` and `frames`.
        backend: the rasteriser backend that runs.
        moments: what masks and poses say of the training frames; None where no masks are completed.
    """
    optim = settings.optim
    plan = stage_decisions(settings, moments)
    plan.append(_mask_decision(settings, moments))
    plan.append(_inpainting_decision(settings, moments))
    share = f"{summary['occluded_frames']} of {summary['frames']} training frames are occluded"
    plan.append(Decision("occlusion handling", optim.pixels == "visible", share))
    plan += _term_decisions("optim", optim, ("rgb", "mask", "ssim", "lpips"))
    plan += sds_decisions(settings, moments)
    is_refined = any(decision.used and decision.part == "stage refine" for decision in plan)
    highest = refined_sh_degree(settings) if is_refined else reached_sh_degree(settings)
    plan.append(
        Decision("spherical harmonics above the active degree", False,
                 f"degree {highest} is the highest reached in the run's steps; higher bands are not allocated")
    )  # fmt: skip
    plan.append(Decision("pose refinement", optim.refine_pose, f"optim.refine_pose = {optim.refine_pose}"))
    plan.append(
        Decision("skinning network", optim.learn_skinning, f"optim.learn_skinning = {optim.learn_skinning}")
    )
    plan.append(Decision("densification", optim.densify, f"optim.densify = {optim.densify}"))
    if is_refined:
        refine = settings.refine
        plan += _term_decisions("refine", refine, ("rgb", "mask"))
        plan.append(_generated_decision(settings, moments))
        plan += _term_decisions("refine", refine, ("ssim", "lpips"))
        reason = f"refine.densify = {refine.densify}"
        plan.append(Decision("densification in the refinement", refine.densify, reason))
    plan.append(Decision("pixels outside the person's padded box", False, _box_reason(moments)))
    plan.append(Decision(f"rasteriser backend {backend}", True, f"rasterizer={settings.rasterizer.name}"))
    return plan


def sds_decisions(settings: Settings, moments: Sequence[Moment] | None) -> list[Decision]:
    """Returns the decisions on the two terms of score distillation, `sds_pose` and `sds_can`, in this order.

    Where no frame is occluded, neither has anything to add to what is seen. Nor has either where every occluded frame
    gets a complete mask (docs/refinement.md has the figures): the whole system then leaves both out, while `C` and
    `D`, which are there to show them, keep them.
    """
    sds = settings.optim.sds
    reasons = [f"optim.sds.lambda_{name} = {getattr(sds, f'lambda_{name}'):g}" for name in ("pose", "can")]
    used = [sds.lambda_pose > 0, sds.lambda_can > 0]
    if used[0] and sds.where == "hidden" and moments is not None:
        hidden = sum(bool(moment.evidence.hidden.any()) for moment in moments)
        reasons[0] += f"; {hidden} of {len(moments)} training frames have hidden pixels to push"
        used[0] = hidden > 0
    if moments is not None and not _occluded(moments):
        reasons = [f"{reason}; {_hidden_reason(moments)}" for reason in reasons]
        used = [False, False]
    elif moments is not None and any(used) and settings.variant.name == "E" and settings.plan == "needed":
        most = max(moment.evidence.hidden_share for moment in moments)
        if most <= MOSTLY_HIDDEN:
            known = f"all {_occluded(moments)} occluded frames get complete masks and show at least {1 - most:.0%}"
            reasons = [f"{reason}; {known} of the body: it changed nothing then" for reason in reasons]
            used = [False, False]
    names = ("loss term sds_pose", "loss term sds_can")
    return [Decision(*parts) for parts in zip(names, used, reasons, strict=True)]


def as_planned(settings: Settings, moments: Sequence[Moment] | None) -> Settings:
    """Returns the settings without the score distillation that the plan leaves out: what training goes by."""
    pose, can = (decision.used for decision in sds_decisions(settings, moments))
    sds = settings.optim.sds
    sds = replace(
        sds, lambda_pose=sds.lambda_pose if pose else 0.0, lambda_can=sds.lambda_can if can else 0.0
    )
    return replace(settings, optim=replace(settings.optim, sds=sds))


def reached_sh_degree(settings: Settings) -> int:
    """Returns the highest SH degree that the optimisation stage reaches; higher bands need not exist."""
    optim = settings.optim
    return min(optim.sh_degree, (steps_of(settings, optim) - 1) // optim.sh_every)


def refined_sh_degree(settings: Settings) -> int:
    """Returns the highest SH degree that the refinement stage reaches."""
    refine = settings.refine
    steps = steps_of(settings, settings.optim) + steps_of(settings, refine)
    return max(reached_sh_degree(settings), min(refine.sh_degree, (steps - 1) // refine.sh_every))


def steps_of(settings: Settings, stage: AvatarSettings) -> int:
    """Returns the steps that a stage takes."""
    return stage.steps if settings.trainer.max_steps is None else settings.trainer.max_steps


def left_out(plan: list[Decision]) -> list[str]:
    """Returns the names of the parts that are not used."""
    return [decision.part for decision in plan if not decision.used]


def plan_json(plan: list[Decision]) -> dict[str, Any]:
    """Returns the plan as it stands in `plan.json`."""
    return {"decisions": [asdict(decision) for decision in plan]}


def stage_decisions(settings: Settings, moments: Sequence[Moment] | None) -> list[Decision]:
    """Returns the decisions on the stages, in order."""
    decisions = []
    for stage in STAGES:
        part, variant = f"stage {stage}", settings.variant.name
        if stage not in settings.variant.stages:
            decisions.append(Decision(part, False, f"variant {variant} does not need it"))
        elif stage not in stages_to_run(settings):
            decisions.append(Decision(part, False, f"stage={settings.stage.name} asks for another"))
        elif stage in HIDDEN_STAGES and moments is not None and not _occluded(moments):
            decisions.append(Decision(part, False, _hidden_reason(moments)))
        else:
            decisions.append(Decision(part, True, f"variant {variant} needs it"))
    return decisions


def with_everything(moments: Sequence[Moment]) -> list[Moment]:
    """Returns the moments with each frame counted as occluded, for `plan=full`."""
    return [replace(moment, evidence=replace(moment.evidence, occluded=True)) for moment in moments]


def _occluded(moments: Sequence[Moment]) -> int:
    return sum(moment.evidence.occluded for moment in moments)


def _hidden_reason(moments: Sequence[Moment]) -> str:
    return f"{_occluded(moments)} of {len(moments)} training frames hide more than {HIDDEN_SHARE:.0%} of the body"


def _generated_decision(settings: Settings, moments: Sequence[Moment] | None) -> Decision:
    """The term on what was inpainted has nothing to look at where nothing was."""
    weight = settings.refine.lambda_gen
    used, reason = weight > 0, f"refine.lambda_gen = {weight:g}"
    if moments is not None and not _occluded(moments):
        used, reason = False, f"{reason}; {_hidden_reason(moments)}"
    return Decision("loss term gen in refine", used, reason)


def _box_reason(moments: Sequence[Moment] | None) -> str:
    reason = "rendered crops hold every Gaussian"
    if not moments:
        return reason
    shares = []
    for moment in moments:
        height, width = moment.evidence.hidden.shape
        low = np.clip(moment.motion.pixels.min(axis=0) - BOX_PADDING, 0, (width, height))
        high = np.clip(moment.motion.pixels.max(axis=0) + BOX_PADDING, 0, (width, height))
        shares.append(float(np.prod(high - low)) / (width * height))
    return (
        f"{reason}; the body's box is {np.mean(shares):.0%} of the picture in the mean of the training frames"
    )


def _mask_decision(settings: Settings, moments: Sequence[Moment] | None) -> Decision:
    if moments is None or "init" not in settings.variant.stages:
        return Decision("complete masks", False, f"variant {settings.variant.name} trains on visible masks")
    return Decision("complete masks", _occluded(moments) > 0, _hidden_reason(moments))


def _inpainting_decision(settings: Settings, moments: Sequence[Moment] | None) -> Decision:
    if moments is None or "refine" not in settings.variant.stages:
        return Decision("inpainting", False, f"variant {settings.variant.name} does not need it")
    reason = f"{_hidden_reason(moments)}; the others are not inpainted"
    return Decision("inpainting", _occluded(moments) > 0, reason)


def _term_decisions(stage: str, settings: AvatarSettings, terms: tuple[str, ...]) -> list[Decision]:
    """Returns the decisions on a stage's loss terms; those of `optim` go by their names alone."""
    where = "" if stage == "optim" else f" in {stage}"
    plan = []
    for name in terms:
        weight = getattr(settings, f"lambda_{name}")
        plan.append(Decision(f"loss term {name}{where}", weight > 0, f"{stage}.lambda_{name} = {weight:g}"))
        if name == "lpips" and weight:
            every, crop = settings.perceptual_every, settings.perceptual_crop
            plan.append(
                Decision(f"perceptual term at every step and on the whole person{where}", every == 1 and crop >= 2048,
                         f"every {every} steps on a random crop of {crop} px: it costs more than all else together")
            )  # fmt: skip
    return plan
