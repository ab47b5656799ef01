"""What a scene needs and what is left out, decided once, each with the measured reason (`plan.json`).

The plan holds the settings that training goes by. Nothing else is worked out from the decisions later.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from occfusion.data.scene_registration import SceneRegistration
from occfusion.human.coverage import BodyCoverage
from occfusion.human.observability import ObservedSurface
from occfusion.observation.frames import ObservedFrames
from occfusion.observation.light import Light
from occfusion.observation.pose_alignment import Alignment
from occfusion.perceptual import training_dtype
from occfusion.plan.decisions import (
    Decision,
    alignment_decision,
    box_reason,
    densification_decision,
    exposure_decision,
    is_perceptual_term_deferred,
    key_light_decision,
    network_decisions,
    perceptual_decision,
    registration_decision,
    start_decision,
    surface_decision,
)
from occfusion.plan.hidden import (
    completion_decision,
    generated_decision,
    hidden_mask_decision,
    hidden_policies,
    inpainting_decision,
    mask_decision,
    masks_at_most,
    reference_decision,
    sds_decisions,
    stage_decisions,
    weighed_for_few,
)
from occfusion.settings.schema import Settings, stages_to_run, steps_of
from occfusion.settings.stages import AvatarSettings, HiddenSettings, SurfaceSettings


@dataclass(frozen=True)
class Plan:
    """What a run does.

    Attributes:
        decisions: on each part, with the reason.
        settings: those that training goes by: without the terms, networks and schedules that are left out.
        stages: those that run, in order.
        inpaints: whether frames are inpainted in the refinement.
    """

    decisions: tuple[Decision, ...]
    settings: Settings
    stages: tuple[str, ...]
    inpaints: bool

    def left_out(self) -> list[str]:
        """Returns the names of the parts that are not used."""
        return [decision.part for decision in self.decisions if not decision.used]

    def json(self) -> dict[str, Any]:
        """Returns the plan as it stands in `plan.json`."""
        return {"decisions": [asdict(decision) for decision in self.decisions]}

    def lines(self) -> list[str]:
        """Returns the plan in a few lines, for the beginning of a run: what is measured, and what that leaves out."""
        told = [d for d in self.decisions if d.part in TOLD and (d.used or d.part in TOLD_IF_NOT)]
        return [
            f"stages: {', '.join(self.stages) or 'none'}",
            *(f"{d.part}: {'yes' if d.used else 'no'}; {d.reason}" for d in told),
        ]


TOLD = (
    "camera correction",
    "evened exposure",
    "completed colours",
    "pose alignment",
    "complete masks",
    "pose refinement",
    "key light",
    "surface prior",
    "densification in the refinement",
)
"""Parts whose decision a user wants to see at once; `plan.json` has them all."""
TOLD_IF_NOT = TOLD[4:]
"""Those of them that are told also where they are not used."""

NO_SURFACE = SurfaceSettings(outline=0.0, backface=0.0, hold=False)


def make_plan(
    settings: Settings,
    summary: Mapping[str, Any],
    backend: str,
    observed_frames: ObservedFrames | None = None,
    light: Light | None = None,
    registered: SceneRegistration | None = None,
    surface: ObservedSurface | None = None,
    coverage: BodyCoverage | None = None,
    device: torch.device | None = None,
    alignment: Alignment | None = None,
) -> Plan:
    """Returns the plan of a run, from its settings and from what the data folder showed.

    Args:
        settings: as the user asked.
        summary: the DataModule's summary; uses `occluded_frames`, `frames` and `frames_unseen`.
        backend: the rasteriser backend that runs.
        observed_frames: what masks and poses say of the training frames; None where nothing depends on it.
        light: what the training frames tell of lamp and exposure; None where nothing depends on it.
        registered: whether pictures lie where the cameras say; None where that was not measured.
        surface: what the video says of the body's surface; None where no frame shows it or nothing depends on it.
        coverage: how well the training frames show the body; None where none does.
        device: where the run computes; the CPU when None.
        alignment: what outlines say of the poses; None where they tell too little or were not asked.
    """
    optim, refine = settings.optim, settings.refine
    stages = stage_decisions(settings, observed_frames)
    running = tuple(
        stage for stage in stages_to_run(settings)
        if any(d.used and d.part == f"stage {stage}" for d in stages)
    )  # fmt: skip
    is_refined = "refine" in running
    inpainting = inpainting_decision(settings, observed_frames)
    inpainter = reference_decision(settings, inpainting)
    hidden = hidden_policies(settings, observed_frames, alignment)
    most = masks_at_most(settings, observed_frames, hidden, inpainter)
    hidden = (weighed_for_few(hidden[0], observed_frames, most), hidden[1])
    perceptual = perceptual_decision("optim", optim, steps_of(settings, optim))
    refined_perceptual = perceptual_decision("refine", refine, steps_of(settings, refine))
    if is_perceptual_term_deferred(settings, refined_perceptual):
        deferred = f"{perceptual.reason}; the refinement that follows has it, and ends the same"
        perceptual = replace(perceptual, used=False, reason=deferred)
    distillation = sds_decisions(settings, observed_frames)
    networks = network_decisions(settings, observed_frames, alignment)
    lamp = key_light_decision(settings, light)
    start = start_decision(settings)
    completed = completion_decision(settings, coverage)
    closed, refined_closed = (surface_decision(settings, stage, surface) for stage in ("optim", "refine"))
    rounds = densification_decision("optim", optim, steps_of(settings, optim))
    refined_rounds = densification_decision("refine", refine, steps_of(settings, refine))
    decided = (
        *distillation, *networks, lamp, start, completed, perceptual, closed, rounds, inpainter,
        refined_perceptual, refined_closed, refined_rounds,
    )  # fmt: skip
    effective = _effective(settings, most, hidden, {decision.part: decision.used for decision in decided})

    plan = [
        registration_decision(registered),
        exposure_decision(settings, light),
        *stages,
        mask_decision(settings, observed_frames, most),
        inpainting,
        inpainter,
    ]
    share = f"{summary['occluded_frames']} of {summary['frames']} training frames are occluded"
    plan.append(Decision("occlusion handling", optim.pixels == "visible", share))
    if unseen := summary["frames_unseen"]:
        reason = f"{unseen} of {unseen + summary['frames']}; steps see {summary['frames']}, evenly spread"
        plan.append(Decision("frames that no step sees", False, reason))
    plan += _weight_decisions("optim", optim, ("rgb", "mask", "ssim"))
    plan.append(hidden_mask_decision("optim", settings, hidden[0], observed_frames, alignment))
    plan += [perceptual, *_perceptual_schedule("optim", optim, perceptual)]
    plan += distillation
    highest = refined_sh_degree(settings) if is_refined else reached_sh_degree(settings)
    plan.append(
        Decision("spherical harmonics above the active degree", False,
                 f"degree {highest} is the highest reached in the run's steps; higher bands are not allocated")
    )  # fmt: skip
    plan += [alignment_decision(settings, alignment), *networks, lamp, start]
    reason = f"optim.observed_colors = {optim.observed_colors}"
    plan.append(Decision("colours of the video at the start", optim.observed_colors, reason))
    plan += [completed, closed, rounds]
    if is_refined:
        plan += _weight_decisions("refine", refine, ("rgb", "mask"))
        plan.append(hidden_mask_decision("refine", settings, hidden[1], observed_frames, alignment))
        plan.append(generated_decision(settings, observed_frames))
        plan += _weight_decisions("refine", refine, ("ssim",))
        plan += [refined_perceptual, *_perceptual_schedule("refine", refine, refined_perceptual)]
        plan += [refined_closed, refined_rounds]
    plan.append(Decision("pixels outside the person's padded box", False, box_reason(observed_frames)))
    plan.append(Decision(f"rasteriser backend {backend}", True, f"rasterizer={settings.rasterizer.name}"))
    plan += precision_decisions(settings, plan, device or torch.device("cpu"))
    return Plan(tuple(plan), effective, running, inpainting.used)


def _effective(
    settings: Settings,
    most: int | None,
    hidden: tuple[HiddenSettings, HiddenSettings],
    used: Mapping[str, bool],
) -> Settings:
    """Returns the settings without what the decisions leave out; `used` says of each part whether it stays."""
    optim, refine = settings.optim, settings.refine
    sds = replace(
        optim.sds,
        lambda_pose=optim.sds.lambda_pose if used["loss term sds_pose"] else 0.0,
        lambda_can=optim.sds.lambda_can if used["loss term sds_can"] else 0.0,
    )
    source = refine.references.source
    if source == "auto":
        source = "prior" if used["references painted by a prior"] else "coarse"
    optim = replace(
        optim,
        sds=sds,
        refine_pose=used["pose refinement"],
        pose_knots=optim.pose_knots if used["pose corrections frame by frame"] else 0,
        learn_skinning=used["skinning network"],
        hidden=hidden[0],
        gaussians=optim.gaussians if used["Gaussians between the body's vertices at the start"] else 0,
        unseen_colors="prior" if used["completed colours"] else "nearest",
        key_light=used["key light"],
        densify=used["densification"],
        lambda_lpips=optim.lambda_lpips if used["loss term lpips"] else 0.0,
        surface=optim.surface if used["surface prior"] else NO_SURFACE,
    )
    refine = replace(
        refine,
        references=replace(refine.references, source=source),
        hidden=hidden[1],
        lambda_lpips=refine.lambda_lpips if used["loss term lpips in refine"] else 0.0,
        densify=used["densification in the refinement"],
        surface=refine.surface if used["surface prior in refine"] else NO_SURFACE,
    )
    return replace(settings, init=replace(settings.init, max_frames=most), optim=optim, refine=refine)


def precision_decisions(settings: Settings, plan: Sequence[Decision], device: torch.device) -> list[Decision]:
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


def _weight_decisions(stage: str, settings: AvatarSettings, terms: tuple[str, ...]) -> list[Decision]:
    """Returns whether loss terms have a weight; those of `optim` go by their names alone."""
    where = "" if stage == "optim" else f" in {stage}"
    weights = {name: getattr(settings, f"lambda_{name}") for name in terms}
    return [
        Decision(f"loss term {name}{where}", weight > 0, f"{stage}.lambda_{name} = {weight:g}")
        for name, weight in weights.items()
    ]


def _perceptual_schedule(stage: str, settings: AvatarSettings, term: Decision) -> list[Decision]:
    """Returns at which steps a perceptual term looks at what, where a stage has one."""
    if not term.used:
        return []
    where = "" if stage == "optim" else f" in {stage}"
    every, crop, first = settings.perceptual_every, settings.perceptual_crop, settings.first_perceptual_step
    since = f", from step {first} of {settings.steps} on" if first else ""
    window = "the whole picture" if crop is None else f"a random crop of {crop} px"
    return [
        Decision(f"perceptual term at every step and on the whole person{where}",
                 every == 1 and crop is None and not first,
                 f"every {every} steps on {window}{since}: it costs more than all else together")
    ]  # fmt: skip
