"""What a scene needs of the parts that are about what is hidden: decided on how much is, and how often."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from occfusion.files.run_folder import STAGES
from occfusion.human.coverage import BodyCoverage
from occfusion.observation.evidence import HIDDEN_SHARE
from occfusion.observation.frames import ObservedFrames, poses_fit
from occfusion.observation.pose_alignment import Alignment
from occfusion.plan.decisions import Decision, may_leave_to_refinement
from occfusion.settings.schema import Settings, stages_to_run
from occfusion.settings.stages import HiddenSettings

HIDDEN_STAGES = ("init",)
"""Stages that are about what is hidden alone: left out where nothing is. The refinement is not one of them: without
references it still trains on, with more Gaussians (docs/experiments/004-leaving-out.md has what that gains)."""
MOSTLY_HIDDEN = 0.9
"""Of the body: a frame that hides more is completed from the pose nearly alone, and its mask is not relied on. A few of
them change nothing (docs/experiments/034-fewer-milliseconds.md)."""
MUCH_UNSEEN = 0.2
"""Share of the body that no frame shows from which its colours are completed. Embedded people who turn round leave 2 to
9 % unseen, those who do not turn 40 to 55 % (docs/experiments/027-completion.md)."""
FITTING_WEIGHT = 0.2
"""Of complete masks on hidden pixels where poses fit as given: these masks are nearly right there."""
LARGEST_WEIGHT = 0.8
"""Of masks that stand for others: what 20 for 80 had when it was tried (docs/experiments/049-long-videos.md)."""


def stage_decisions(settings: Settings, observed_frames: ObservedFrames | None) -> list[Decision]:
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


def mask_decision(
    settings: Settings, observed_frames: ObservedFrames | None, most: int | None = None
) -> Decision:
    """Returns whether any mask is completed; `most` is of `masks_at_most`."""
    if observed_frames is None or "init" not in settings.variant.stages:
        return Decision("complete masks", False, f"variant {settings.variant.name} trains on visible masks")
    reason, count = _hidden_reason(observed_frames), _all_occluded(observed_frames)
    if most is not None:
        them = f"{most} of {count}" if count == _occluded(observed_frames) else f"{most} of about {count}"
        reason += f"; {them} are completed, evenly spread (init.max_frames): other frames tell better"
    return Decision("complete masks", count > 0, reason)


def masks_at_most(
    settings: Settings,
    observed_frames: ObservedFrames | None,
    hidden: Sequence[HiddenSettings],
    inpainter: Decision,
) -> int | None:
    """Returns how many masks are completed where that is not one for each occluded frame.

    Where other frames tell better what is hidden, masks of 40 of 1000 frames do what all do, and 20 of 80
    (docs/experiments/049-long-videos.md). All are made where nothing is trained on them: they are what was asked for.

    Args:
        settings: as the user asked.
        observed_frames: of the training frames.
        hidden: of both stages, as `hidden_policies` decided: where complete masks count fully, all are made.
        inpainter: of `reference_decision`: a prior that paints references is given complete masks.
    """
    most = settings.init.max_frames
    are_asked = "complete" in (settings.optim.hidden.target, settings.refine.hidden.target)
    is_trained = any(stage != "init" for stage in stages_to_run(settings))
    counts_fully = any(of_stage.effective_weight == 1.0 for of_stage in hidden)
    are_all_needed = inpainter.used or counts_fully or are_asked or not is_trained
    if most is None or observed_frames is None or are_all_needed or _all_occluded(observed_frames) <= most:
        return None
    return most


def inpainting_decision(settings: Settings, observed_frames: ObservedFrames | None) -> Decision:
    """Returns whether any frame is inpainted."""
    if observed_frames is None or "refine" not in settings.variant.stages:
        return Decision("inpainting", False, f"variant {settings.variant.name} does not need it")
    reason = f"{_hidden_reason(observed_frames)}; the others are not inpainted"
    return Decision("inpainting", _occluded(observed_frames) > 0, reason)


def reference_decision(settings: Settings, inpainting: Decision) -> Decision:
    """Returns whether a prior paints the references: one of the user's, or where they count in all that a frame hides.

    Of what no frame shows, the avatar's own rendering does as well as our own network: its colours there were taken
    from what is seen nearby, or completed on the body, once and for all views (docs/experiments/043-painted-once.md).
    Of other priors that is not known.
    """
    part, references = "references painted by a prior", settings.refine.references
    reason = f"refine.references.source = {references.source}"
    if references.source != "auto":
        return Decision(part, inpainting.used and references.source == "prior", reason)
    if not inpainting.used:
        return Decision(part, False, f"{reason}; no frame is inpainted")
    if settings.plan == "full":
        return Decision(part, True, f"{reason}; plan = full")
    reason += f"; prior = {settings.prior.name}, refine.references.pixels = {references.pixels}"
    if references.pixels == "unseen" and settings.prior.name == "embedded":
        return Decision(
            part, False, f"{reason}: what no frame shows is painted on the avatar, which is drawn instead"
        )
    return Decision(part, True, reason)


def generated_decision(settings: Settings, observed_frames: ObservedFrames | None) -> Decision:
    """The term on what was inpainted has nothing to look at where nothing was."""
    weight = settings.refine.references.weight
    used, reason = weight > 0, f"refine.references.weight = {weight:g}"
    if observed_frames is not None and not _occluded(observed_frames):
        used, reason = False, f"{reason}; {_hidden_reason(observed_frames)}"
    return Decision("loss term gen in refine", used, reason)


def sds_decisions(settings: Settings, observed_frames: ObservedFrames | None) -> list[Decision]:
    """Returns the decisions on the two terms of score distillation, `sds_pose` and `sds_can`, in this order.

    Where no frame is occluded, neither has anything to add to what is seen. Nor has either where occluded frames
    get complete masks, most of them show some of the person, and a refinement follows: both are left out then.
    Variants without a refinement, which are there to show the terms, keep them.
    """
    sds = settings.optim.sds
    reasons = [f"optim.sds.lambda_{name} = {getattr(sds, f'lambda_{name}'):g}" for name in ("pose", "can")]
    used = [sds.lambda_pose > 0, sds.lambda_can > 0]
    if used[0] and sds.where == "hidden" and observed_frames is not None:
        hidden = sum(bool(own.evidence.hidden.any()) for own in observed_frames.judged)
        reasons[0] += f"; {hidden} of {_frames(observed_frames)} have hidden pixels to push"
        used[0] = hidden > 0
    if observed_frames is not None and not _occluded(observed_frames):
        reasons = [f"{reason}; {_hidden_reason(observed_frames)}" for reason in reasons]
        used = [False, False]
    elif observed_frames is not None and any(used) and may_leave_to_refinement(settings):
        shares = [f.evidence.hidden_share for f in observed_frames.judged if f.evidence.occluded]
        median = float(np.median(shares))
        if median <= MOSTLY_HIDDEN:
            known = f"masks are completed, and half of the {len(shares)} occluded frames show at least"
            known += f" {1 - median:.0%} of the body: it changed nothing then"
            reasons = [f"{reason}; {known}" for reason in reasons]
            used = [False, False]
    names = ("loss term sds_pose", "loss term sds_can")
    return [Decision(*parts) for parts in zip(names, used, reasons, strict=True)]


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


def hidden_policies(
    settings: Settings, observed_frames: ObservedFrames | None, alignment: Alignment | None = None
) -> tuple[HiddenSettings, HiddenSettings]:
    """Returns what hidden pixels are held to in the optimisation and in the refinement, target and weight decided.

    What `auto` means: with `plan=full` complete masks in full, as in the paper. Else complete masks count for little
    where other frames tell better: by `FITTING_WEIGHT` where poses fit as given, were aligned, from which these masks
    are made, or are left alone as outlines do not say that they are off; for nothing where training mends them. The
    refinement holds what is hidden to the avatar's own outline instead, where no poses are mended much, which move it.
    The optimisation counts masks as a refinement that follows would, and fully where none does
    (docs/experiments/033-refinement-after-alignment.md).
    """
    optim, refine = settings.optim.hidden, settings.refine.hidden
    full, fits = HiddenSettings("complete", 1.0), poses_fit(observed_frames) or alignment is not None
    doubted = HiddenSettings("complete", FITTING_WEIGHT) if fits else HiddenSettings("none", 0.0)
    if optim.target == "auto":
        chosen = refine if refine.target in ("complete", "none") else doubted
        optim = chosen if may_leave_to_refinement(settings) else full
    if refine.target == "auto":
        own = HiddenSettings("outline") if fits else doubted
        refine = full if settings.plan == "full" else own
    return tuple(replace(each, weight=each.effective_weight) for each in (optim, refine))  # type: ignore[return-value]


def weighed_for_few(
    hidden: HiddenSettings, observed_frames: ObservedFrames | None, most: int | None
) -> HiddenSettings:
    """Returns what the optimisation holds hidden pixels to where some masks stand for all: each counts for others too.

    Args:
        hidden: of the optimisation, as `hidden_policies` decided.
        observed_frames: of the training frames.
        most: of `masks_at_most`.
    """
    if most is None or observed_frames is None or hidden.target != "complete":
        return hidden
    weight = hidden.effective_weight
    return replace(
        hidden, weight=max(weight, min(LARGEST_WEIGHT, weight * _all_occluded(observed_frames) / most))
    )


def hidden_mask_decision(
    stage: str,
    settings: Settings,
    hidden: HiddenSettings,
    observed_frames: ObservedFrames | None,
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
        if _is_taken(alignment):
            found = "poses are aligned: "
        else:
            found = "poses fit as given: " if fits else "outlines do not say that poses are off: "
        why = found if asked == "auto" else ""
        reason += f"{why}the avatar's own outline takes the place of complete masks, weight {weight:g}"
        return Decision(part, False, reason)
    reason += f"it counts {weight:g} there"
    if stage == "optim" and weight < 1.0:
        reason += ": other frames tell better"
    if "refine" in settings.variant.stages and fits:
        reason += "; poses fit as given, so complete masks do"
    return Decision(part, weight == 1.0, reason)


def _is_taken(alignment: Alignment | None) -> bool:
    return alignment is not None and alignment.is_taken


def with_everything(observed_frames: ObservedFrames) -> ObservedFrames:
    """Returns the observed_frames with each frame counted as occluded, for `plan=full`."""
    return observed_frames.changed(
        lambda frame: replace(frame, evidence=replace(frame.evidence, occluded=True))
    )


def _occluded(observed_frames: ObservedFrames) -> int:
    """Returns how many of the frames that decisions go by are occluded."""
    return sum(observed_frame.evidence.occluded for observed_frame in observed_frames.judged)


def _all_occluded(observed_frames: ObservedFrames) -> int:
    """Returns how many of all frames are occluded, by those that decisions go by."""
    return round(_occluded(observed_frames) * len(observed_frames) / max(1, len(observed_frames.sample)))


def _frames(observed_frames: ObservedFrames) -> str:
    """Returns how many frames decisions go by, in words."""
    judged = len(observed_frames.sample)
    return f"{judged} training frames" + ("" if judged == len(observed_frames) else ", evenly spread,")


def _hidden_reason(observed_frames: ObservedFrames) -> str:
    hiding = sum(own.evidence.hidden_share > HIDDEN_SHARE for own in observed_frames.judged)
    frames = f"{hiding} of {_frames(observed_frames)}"
    all_taken = "; plan=full takes all of them for occluded" if _occluded(observed_frames) > hiding else ""
    return f"{frames} hide more than {HIDDEN_SHARE:.0%} of the body{all_taken}"
