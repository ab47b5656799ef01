"""What a scene needs of the system, decided on what its masks and poses show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from occfusion.data.scene_registration import SceneRegistration
from occfusion.files.run_folder import STAGES
from occfusion.human.coverage import BodyCoverage
from occfusion.human.observability import ObservedSurface
from occfusion.observation.evidence import FITTING, HIDDEN_SHARE
from occfusion.observation.frames import ObservedFrame, misfit_of, poses_fit
from occfusion.observation.key_light import KeyLight
from occfusion.observation.pose_alignment import Alignment
from occfusion.settings.schema import Settings, stages_to_run
from occfusion.settings.stages import AvatarSettings, HiddenSettings
from occfusion.stages.avatar import BOX_PADDING

HIDDEN_STAGES = ("init",)
"""Stages that are about what is hidden alone: left out where nothing is. The refinement is not one of them: without
references it still trains on, with more Gaussians (docs/experiments/004-leaving-out.md has what that gains)."""

MOSTLY_HIDDEN = 0.9
"""Of the body: a frame that hides more is completed from the pose nearly alone, and its mask is not relied on. A few of
them change nothing (docs/experiments/034-fewer-milliseconds.md)."""

LIT = 0.1
"""Of the differences between sightings of a point of the body: a lamp that explains less is left out."""
DETERMINED = 50.0
"""Condition up to which the frames tell where a lamp is; embedded scenes have 4 to 8
(docs/experiments/015-key-light.md)."""


MUCH_UNSEEN = 0.2
"""Share of the body that no frame shows from which its colours are completed. Embedded people who turn round leave 2 to
9 % unseen, those who do not turn 40 to 55 % (docs/experiments/027-completion.md)."""

TURNED = 33.0
"""Degrees of turning from which the surface is not closed. Embedded people who face the camera within 15 degrees to
both sides have 23 (their limbs turn too), the man of the real clip 13, those who turn half round or more 43: closing
costs exact scenes of those 0.2 dB (docs/experiments/026-surface.md)."""


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


def registration_decision(registered: SceneRegistration | None) -> Decision:
    """Returns whether cameras are corrected: where pictures are certainly shifted or scaled against them."""
    part = "camera correction"
    if registered is None:
        return Decision(part, False, "registration = off; nothing was measured")
    return Decision(part, bool(registered.corrections), registered.text())


def stage_decisions(settings: Settings, observed_frames: Sequence[ObservedFrame] | None) -> list[Decision]:
    """Returns the decisions on the stages, in order."""
    decisions = []
    for stage in STAGES:
        part, variant = f"stage {stage}", settings.variant.name
        if stage not in settings.variant.stages:
            decisions.append(Decision(part, False, f"variant {variant} does not need it"))
        elif stage not in stages_to_run(settings):
            decisions.append(Decision(part, False, f"stage={settings.stage.name} asks for another"))
        elif stage in HIDDEN_STAGES and observed_frames is not None and not _occluded(observed_frames):
            decisions.append(Decision(part, False, _hidden_reason(observed_frames)))
        else:
            decisions.append(Decision(part, True, f"variant {variant} needs it"))
    return decisions


def sds_decisions(settings: Settings, observed_frames: Sequence[ObservedFrame] | None) -> list[Decision]:
    """Returns the decisions on the two terms of score distillation, `sds_pose` and `sds_can`, in this order.

    Where no frame is occluded, neither has anything to add to what is seen. Nor has either where every occluded frame
    gets a complete mask, most of them show some of the person, and a refinement follows: both are left out then.
    Variants without a refinement, which are there to show the terms, keep them.
    """
    sds = settings.optim.sds
    reasons = [f"optim.sds.lambda_{name} = {getattr(sds, f'lambda_{name}'):g}" for name in ("pose", "can")]
    used = [sds.lambda_pose > 0, sds.lambda_can > 0]
    if used[0] and sds.where == "hidden" and observed_frames is not None:
        hidden = sum(bool(observed_frame.evidence.hidden.any()) for observed_frame in observed_frames)
        reasons[0] += f"; {hidden} of {len(observed_frames)} training frames have hidden pixels to push"
        used[0] = hidden > 0
    if observed_frames is not None and not _occluded(observed_frames):
        reasons = [f"{reason}; {_hidden_reason(observed_frames)}" for reason in reasons]
        used = [False, False]
    elif observed_frames is not None and any(used) and _may_leave_out(settings):
        shares = [f.evidence.hidden_share for f in observed_frames if f.evidence.occluded]
        median = float(np.median(shares))
        if median <= MOSTLY_HIDDEN:
            known = f"all {len(shares)} occluded frames get complete masks, and half of them show at least"
            reasons = [
                f"{reason}; {known} {1 - median:.0%} of the body: it changed nothing then"
                for reason in reasons
            ]
            used = [False, False]
    names = ("loss term sds_pose", "loss term sds_can")
    return [Decision(*parts) for parts in zip(names, used, reasons, strict=True)]


def alignment_decision(settings: Settings, alignment: Alignment | None) -> Decision:
    """Returns whether poses are aligned with the outlines of masks: where these tell anything."""
    part, reason = "pose alignment", f"optim.align_poses = {settings.optim.align_poses}"
    if not is_alignment_asked(settings):
        return Decision(part, False, f"{reason}, optim.pose_knots = {settings.optim.pose_knots}")
    if alignment is None:
        return Decision(part, False, f"{reason}; too few frames show an outline")
    return Decision(part, alignment.is_taken, f"{reason}; {alignment.text()}")


def is_alignment_asked(settings: Settings) -> bool:
    """Returns whether the settings ask for poses that are aligned with outlines before anything is trained."""
    return settings.optim.align_poses and settings.optim.pose_knots > 0


def network_decisions(
    settings: Settings,
    observed_frames: Sequence[ObservedFrame] | None,
    alignment: Alignment | None = None,
) -> list[Decision]:
    """Returns the decisions on pose refinement, corrections frame by frame, and the skinning network, in this order.

    They mend poses. Where these were aligned, corrections frame by frame move as far as the video tells that poses are
    off, and the networks, which move all angles alike, are left out. Where an alignment was not worth it, nothing is
    mended. Where none was found, all are left out if poses fit: the masks of the frames that show a whole person then
    show the person wherever the body model has it.
    """
    optim = settings.optim
    decisions = [
        Decision("pose refinement", optim.refine_pose, f"optim.refine_pose = {optim.refine_pose}"),
        Decision(
            "pose corrections frame by frame", optim.pose_knots > 0, f"optim.pose_knots = {optim.pose_knots}"
        ),
        Decision("skinning network", optim.learn_skinning, f"optim.learn_skinning = {optim.learn_skinning}"),
    ]
    if alignment is not None and not alignment.is_taken and settings.plan == "needed":
        why = "outlines do not say that poses are off"
        return [replace(d, used=False, reason=f"{d.reason}; {why}") for d in decisions]
    if alignment is not None and settings.plan == "needed":
        why = "poses are aligned with outlines, and mended frame by frame as far as the video tells"
        left = [replace(d, used=False, reason=f"{d.reason}; {why}") for d in (decisions[0], decisions[2])]
        return [left[0], decisions[1], left[1]]
    measured = misfit_of(observed_frames)
    if not may_leave_out_networks(settings) or measured is None:
        return decisions
    misfit, count = measured
    shown = (
        f"{misfit:.3%} of the body lies outside the mask (median of {count} frames that show a whole person)"
    )
    shown += f"; {FITTING:.2%} would need mending"
    return [replace(d, used=d.used and misfit >= FITTING, reason=f"{d.reason}; {shown}") for d in decisions]


def perceptual_decision(stage: str, settings: AvatarSettings, steps: int) -> Decision:
    """Returns whether a stage has a perceptual term: where it has a weight and one of the steps is due."""
    part = "loss term lpips" + ("" if stage == "optim" else f" in {stage}")
    weight, first = settings.lambda_lpips, settings.first_perceptual_step
    reason = f"{stage}.lambda_lpips = {weight:g}"
    if weight and first >= steps:
        share = settings.perceptual_from
        reason += f"; {stage}.perceptual_from = {share:g} begins at step {first}, and {steps} are taken"
    return Decision(part, weight > 0 and first < steps, reason)


def is_perceptual_term_deferred(settings: Settings, refined: Decision) -> bool:
    """Returns whether the optimisation goes without its perceptual term, as the refinement that follows has one.

    The end of the refinement is the same (docs/experiments/004-leaving-out.md), and the term is half of what the
    optimisation costs. `refined` says whether the refinement has one.
    """
    return settings.optim.lambda_lpips > 0 and refined.used and _may_leave_out(settings)


def start_decision(settings: Settings) -> Decision:
    """Returns whether there are more Gaussians at the start than the body has vertices.

    Where a refinement follows, that is left to it: it adds them where they are needed.
    """
    asked, reason = settings.optim.gaussians > 0, f"optim.gaussians = {settings.optim.gaussians}"
    added = asked and _may_leave_out(settings) and settings.refine.densify
    reason += "; the refinement adds Gaussians where they are needed" if added else ""
    return Decision("Gaussians between the body's vertices at the start", asked and not added, reason)


def key_light_decision(settings: Settings, found: KeyLight | None) -> Decision:
    """Returns whether colours change with a lamp: where one explains much of how body points change as they turn."""
    part, reason = "key light", f"optim.key_light = {settings.optim.key_light}"
    if not settings.optim.key_light:
        return Decision(part, False, reason)
    if found is None:
        return Decision(part, False, f"{reason}; too little of the body is seen often enough to tell")
    reason += f"; a lamp explains {found.explained:.0%} of how points of the body change as they turn"
    if found.condition > DETERMINED:
        return Decision(part, False, f"{reason}; the frames do not tell where it is")
    used = found.explained >= LIT or settings.plan == "full"
    return Decision(part, used, reason if used else f"{reason}; {LIT:.0%} would be worth it")


def completion_decision(settings: Settings, coverage: BodyCoverage | None) -> Decision:
    """Returns whether a network completes the colours of what no frame shows: where that is much of the body."""
    part, asked = "completed colours", settings.optim.unseen_colors
    reason = f"optim.unseen_colors = {asked}"
    if asked == "nearest":
        return Decision(part, False, reason)
    if coverage is None:
        return Decision(part, asked == "prior", f"{reason}; no training frame shows the body")
    unseen = coverage.shares()["unseen"]
    reason += f"; {unseen:.0%} of the body is not seen, from {MUCH_UNSEEN:.0%} on it is worth it"
    return Decision(part, asked == "prior" or unseen >= MUCH_UNSEEN or settings.plan == "full", reason)


def surface_decision(settings: Settings, stage: str, surface: ObservedSurface | None) -> Decision:
    """Returns whether a stage closes the surface where the video does not tell: where that is anywhere."""
    own: AvatarSettings = getattr(settings, stage)
    part = "surface prior" if stage == "optim" else f"surface prior in {stage}"
    if not own.surface.is_used:
        return Decision(part, False, f"all weights of {stage}.surface are 0")
    if surface is None:
        return Decision(part, False, "no training frame shows the body")
    reason = (
        f"directions to the camera spread by {surface.turn:.0f} degrees about their axis, on average over places; a "
        f"person who turns has {TURNED:.0f} or more. The video leaves {surface.ignorance:.0%} of the surface open"
    )
    return Decision(part, surface.turn < TURNED or settings.plan == "full", reason)


def may_leave_out_networks(settings: Settings) -> bool:
    """Returns whether how well poses fit decides on pose refinement and the skinning network."""
    optim = settings.optim
    asked = optim.refine_pose or optim.pose_knots > 0 or optim.learn_skinning
    return asked and settings.plan == "needed"


def generated_decision(settings: Settings, observed_frames: Sequence[ObservedFrame] | None) -> Decision:
    """The term on what was inpainted has nothing to look at where nothing was."""
    weight = settings.refine.references.weight
    used, reason = weight > 0, f"refine.references.weight = {weight:g}"
    if observed_frames is not None and not _occluded(observed_frames):
        used, reason = False, f"{reason}; {_hidden_reason(observed_frames)}"
    return Decision("loss term gen in refine", used, reason)


FITTING_WEIGHT = 0.2
"""Of complete masks on hidden pixels where poses fit as given: these masks are nearly right there."""


def hidden_policies(
    settings: Settings, observed_frames: Sequence[ObservedFrame] | None, alignment: Alignment | None = None
) -> tuple[HiddenSettings, HiddenSettings]:
    """Returns what hidden pixels are held to in the optimisation and in the refinement, target and weight decided.

    What `auto` means: with `plan=full` complete masks in full, as in the paper. Else complete masks count for little
    where other frames tell better: by `FITTING_WEIGHT` where poses fit as given or were aligned, from which these
    masks are made, and for nothing where they are mended. The refinement holds what is hidden to the avatar's own
    outline instead, where no poses are mended much, which move it. The optimisation counts masks as a refinement that
    follows would, and fully where none does (docs/experiments/033-refinement-after-alignment.md).
    """
    optim, refine = settings.optim.hidden, settings.refine.hidden
    full, fits = HiddenSettings("complete", 1.0), poses_fit(observed_frames) or _is_taken(alignment)
    doubted = HiddenSettings("complete", FITTING_WEIGHT) if fits else HiddenSettings("none", 0.0)
    if optim.target == "auto":
        chosen = refine if refine.target in ("complete", "none") else doubted
        optim = chosen if _may_leave_out(settings) else full
    if refine.target == "auto":
        own = HiddenSettings("outline") if fits else doubted
        refine = full if settings.plan == "full" else own
    return tuple(replace(each, weight=each.effective_weight) for each in (optim, refine))  # type: ignore[return-value]


def _is_taken(alignment: Alignment | None) -> bool:
    return alignment is not None and alignment.is_taken


def hidden_mask_decision(
    stage: str,
    settings: Settings,
    hidden: HiddenSettings,
    observed_frames: Sequence[ObservedFrame] | None,
    alignment: Alignment | None = None,
) -> Decision:
    """Returns whether the mask term counts fully on hidden pixels: what is there, other frames may tell better.

    Args:
        stage: `optim` or `refine`.
        settings: as the user asked.
        hidden: of the stage, as `hidden_policies` decided.
        observed_frames: of the training frames.
        alignment: what outlines say of the poses; None where they tell too little or were not asked.
    """
    weight, asked = hidden.effective_weight, getattr(settings, stage).hidden.target
    part = "full mask term on hidden pixels" + ("" if stage == "optim" else f" in {stage}")
    if observed_frames is not None and not _occluded(observed_frames):
        return Decision(part, False, _hidden_reason(observed_frames))
    reason = f"{stage}.hidden.target = {asked}; " if asked != "auto" else ""
    fits = poses_fit(observed_frames)
    if hidden.target == "outline":
        found = "poses are aligned: " if _is_taken(alignment) else "poses fit as given: "
        why = found if asked == "auto" else ""
        reason += f"{why}the avatar's own outline takes the place of complete masks, weight {weight:g}"
        return Decision(part, False, reason)
    reason += f"it counts {weight:g} there"
    if stage == "optim" and weight < 1.0:
        reason += ": other frames tell better"
    if "refine" in settings.variant.stages and fits:
        reason += "; poses fit as given, so complete masks do"
    return Decision(part, weight == 1.0, reason)


def densification_decision(stage: str, settings: AvatarSettings, steps: int) -> Decision:
    """Returns whether Gaussians are added and removed: where that is asked and a round falls into the steps."""
    part = "densification" + ("" if stage == "optim" else " in the refinement")
    reason = f"{stage}.densify = {settings.densify}"
    if not settings.densify:
        return Decision(part, False, reason)
    rounds = settings.densification.rounds(steps)
    if not rounds:
        schedule = settings.densification
        reason += (
            f"; no round falls into {steps} steps (after {schedule.after_step}, every {schedule.every}, before "
            f"{schedule.before_step})"
        )
        return Decision(part, False, reason)
    return Decision(part, True, f"{reason}; rounds at steps {', '.join(map(str, rounds))} of {steps}")


def box_reason(observed_frames: Sequence[ObservedFrame] | None) -> str:
    """Returns how much of the pictures is rendered, where that is known."""
    reason = "rendered crops hold every Gaussian"
    if not observed_frames:
        return reason
    shares = []
    for observed_frame in observed_frames:
        height, width = observed_frame.evidence.hidden.shape
        pixels = observed_frame.projected.pixels
        low = np.clip(pixels.min(axis=0) - BOX_PADDING, 0, (width, height))
        high = np.clip(pixels.max(axis=0) + BOX_PADDING, 0, (width, height))
        shares.append(float(np.prod(high - low)) / (width * height))
    return (
        f"{reason}; the body's box is {np.mean(shares):.0%} of the picture in the mean of the training frames"
    )


def mask_decision(settings: Settings, observed_frames: Sequence[ObservedFrame] | None) -> Decision:
    """Returns whether any mask is completed."""
    if observed_frames is None or "init" not in settings.variant.stages:
        return Decision("complete masks", False, f"variant {settings.variant.name} trains on visible masks")
    return Decision("complete masks", _occluded(observed_frames) > 0, _hidden_reason(observed_frames))


def inpainting_decision(settings: Settings, observed_frames: Sequence[ObservedFrame] | None) -> Decision:
    """Returns whether any frame is inpainted."""
    if observed_frames is None or "refine" not in settings.variant.stages:
        return Decision("inpainting", False, f"variant {settings.variant.name} does not need it")
    reason = f"{_hidden_reason(observed_frames)}; the others are not inpainted"
    return Decision("inpainting", _occluded(observed_frames) > 0, reason)


def with_everything(observed_frames: Sequence[ObservedFrame]) -> list[ObservedFrame]:
    """Returns the observed_frames with each frame counted as occluded, for `plan=full`."""
    return [
        replace(observed_frame, evidence=replace(observed_frame.evidence, occluded=True))
        for observed_frame in observed_frames
    ]


def _may_leave_out(settings: Settings) -> bool:
    """Returns whether parts may go that a refinement makes up for: where one follows, unless all is asked."""
    return "refine" in settings.variant.stages and settings.plan == "needed"


def _occluded(observed_frames: Sequence[ObservedFrame]) -> int:
    return sum(observed_frame.evidence.occluded for observed_frame in observed_frames)


def _hidden_reason(observed_frames: Sequence[ObservedFrame]) -> str:
    hiding = sum(observed_frame.evidence.hidden_share > HIDDEN_SHARE for observed_frame in observed_frames)
    reason = (
        f"{hiding} of {len(observed_frames)} training frames hide more than {HIDDEN_SHARE:.0%} of the body"
    )
    return (
        reason
        if _occluded(observed_frames) <= hiding
        else f"{reason}; plan=full takes all of them for occluded"
    )
