"""What a scene needs and what is left out, each with the measured reason (`plan.json`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import torch

from occfusion.config import Settings
from occfusion.needs import (
    Decision,
    box_reason,
    correction_decision,
    generated_decision,
    hidden_mask_decision,
    inpainting_decision,
    is_perceptual_term_deferred,
    key_light_decision,
    mask_decision,
    network_decisions,
    sds_decisions,
    stage_decisions,
    start_decision,
)
from occfusion.perceptual import training_dtype
from occfusion.priors.key_light import KeyLight
from occfusion.priors.moments import Moment
from occfusion.stages.settings import AvatarSettings


def make_plan(
    settings: Settings,
    summary: Mapping[str, Any],
    backend: str,
    moments: Sequence[Moment] | None = None,
    key_light: KeyLight | None = None,
) -> list[Decision]:
    """Returns the decisions for a run, from its settings and from what the data folder showed.

    Args:
        settings: the run's settings.
        summary: the DataModule's summary; uses `occluded_frames` and `frames`.
        backend: the rasteriser backend that runs.
        moments: what masks and poses say of the training frames; None where nothing depends on it.
        key_light: the lamp that the training frames show; None where they show none or nothing depends on it.
    """
    optim = settings.optim
    plan = stage_decisions(settings, moments)
    plan.append(mask_decision(settings, moments))
    plan.append(inpainting_decision(settings, moments))
    share = f"{summary['occluded_frames']} of {summary['frames']} training frames are occluded"
    plan.append(Decision("occlusion handling", optim.pixels == "visible", share))
    plan += _term_decisions("optim", optim, ("rgb", "mask", "ssim"))
    plan.append(hidden_mask_decision("optim", settings, moments))
    if is_perceptual_term_deferred(settings):
        reason = f"optim.lambda_lpips = {optim.lambda_lpips:g}; the refinement that follows has it, and ends the same"
        plan.append(Decision("loss term lpips", False, reason))
    else:
        plan += _term_decisions("optim", optim, ("lpips",))
    plan += sds_decisions(settings, moments)
    is_refined = any(decision.used and decision.part == "stage refine" for decision in plan)
    highest = refined_sh_degree(settings) if is_refined else reached_sh_degree(settings)
    plan.append(
        Decision("spherical harmonics above the active degree", False,
                 f"degree {highest} is the highest reached in the run's steps; higher bands are not allocated")
    )  # fmt: skip
    networks = network_decisions(settings, moments)
    plan += networks
    plan.append(correction_decision("optim", optim, networks))
    plan.append(key_light_decision(settings, key_light))
    plan.append(start_decision(settings))
    reason = f"optim.observed_colors = {optim.observed_colors}"
    plan.append(Decision("colours of the video at the start", optim.observed_colors, reason))
    plan.append(Decision("densification", optim.densify, f"optim.densify = {optim.densify}"))
    if is_refined:
        refine = settings.refine
        plan += _term_decisions("refine", refine, ("rgb", "mask"))
        plan.append(hidden_mask_decision("refine", settings, moments))
        plan.append(generated_decision(settings, moments))
        plan += _term_decisions("refine", refine, ("ssim", "lpips"))
        plan.append(correction_decision("refine", refine, networks))
        reason = f"refine.densify = {refine.densify}"
        plan.append(Decision("densification in the refinement", refine.densify, reason))
    plan.append(Decision("pixels outside the person's padded box", False, box_reason(moments)))
    plan.append(Decision(f"rasteriser backend {backend}", True, f"rasterizer={settings.rasterizer.name}"))
    return plan


def precision_decisions(settings: Settings, plan: list[Decision], device: torch.device) -> list[Decision]:
    """Returns whether single precision is left out of the perceptual term, where a plan has one and that was asked."""
    asked = settings.perceptual.precision
    if asked == "float32" or not any(d.used and d.part.startswith("loss term lpips") for d in plan):
        return []
    single = training_dtype(asked, device) == torch.float32
    natively = f"{device.type} {'does not multiply' if single else 'multiplies'} bfloat16 natively"
    reason = f"perceptual.precision = {asked}" + (f"; this {natively}" if asked == "auto" else "")
    return [Decision("single precision in the perceptual term", single, reason)]


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
