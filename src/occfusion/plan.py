"""What a scene needs and what is left out, each with the measured reason (`plan.json`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from occfusion.config import STAGES, Settings, stages_to_run
from occfusion.priors.evidence import HIDDEN_SHARE
from occfusion.priors.moments import Moment
from occfusion.stages.settings import AvatarSettings


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
    steps = optim.steps if settings.trainer.max_steps is None else settings.trainer.max_steps
    plan = [_stage_decision(stage, settings) for stage in STAGES]
    plan.append(_mask_decision(settings, moments))
    share = f"{summary['occluded_frames']} of {summary['frames']} training frames are occluded"
    plan.append(Decision("occlusion handling", optim.pixels == "visible", share))
    for name in ("rgb", "mask", "ssim", "lpips"):
        weight = getattr(optim, f"lambda_{name}")
        plan.append(Decision(f"loss term {name}", weight > 0, f"optim.lambda_{name} = {weight:g}"))
    if optim.lambda_lpips:
        every, crop = optim.perceptual_every, optim.perceptual_crop
        plan.append(
            Decision("perceptual term at every step and on the whole person", every == 1 and crop >= 2048,
                     f"every {every} steps on a random crop of {crop} px: it costs more than all else together")
        )  # fmt: skip
    plan += sds_decisions(settings, moments)
    highest = reached_sh_degree(settings)
    plan.append(
        Decision("spherical harmonics above the active degree", False,
                 f"degree {highest} is the highest reached in {steps} steps; higher bands are not allocated")
    )  # fmt: skip
    plan.append(Decision("pose refinement", optim.refine_pose, f"optim.refine_pose = {optim.refine_pose}"))
    plan.append(
        Decision("skinning network", optim.learn_skinning, f"optim.learn_skinning = {optim.learn_skinning}")
    )
    plan.append(Decision("densification", optim.densify, f"optim.densify = {optim.densify}"))
    plan.append(
        Decision("pixels outside the person's padded box", False, "rendered crops hold every Gaussian")
    )
    plan.append(Decision(f"rasteriser backend {backend}", True, f"rasterizer={settings.rasterizer.name}"))
    return plan


def sds_decisions(settings: Settings, moments: Sequence[Moment] | None) -> list[Decision]:
    """Returns the decisions on the two terms of score distillation, `sds_pose` and `sds_can`, in this order."""
    sds = settings.optim.sds
    reasons = [f"optim.sds.lambda_{name} = {getattr(sds, f'lambda_{name}'):g}" for name in ("pose", "can")]
    used = [sds.lambda_pose > 0, sds.lambda_can > 0]
    if used[0] and sds.where == "hidden" and moments is not None:
        hidden = sum(bool(moment.evidence.hidden.any()) for moment in moments)
        reasons[0] += f"; {hidden} of {len(moments)} training frames have hidden pixels to push"
        used[0] = hidden > 0
    names = ("loss term sds_pose", "loss term sds_can")
    return [Decision(*parts) for parts in zip(names, used, reasons, strict=True)]


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


def _mask_decision(settings: Settings, moments: Sequence[Moment] | None) -> Decision:
    if moments is None:
        return Decision("complete masks", False, f"variant {settings.variant.name} trains on visible masks")
    occluded = sum(moment.evidence.occluded for moment in moments)
    reason = f"{occluded} of {len(moments)} training frames hide more than {HIDDEN_SHARE:.0%} of the body"
    return Decision("complete masks", occluded > 0, reason)


def _stage_decision(stage: str, settings: Settings) -> Decision:
    if stage not in settings.variant.stages:
        return Decision(f"stage {stage}", False, f"variant {settings.variant.name} does not need it")
    if stage not in stages_to_run(settings):
        return Decision(f"stage {stage}", False, f"stage={settings.stage.name} asks for another")
    return Decision(f"stage {stage}", True, f"variant {settings.variant.name} needs it")
