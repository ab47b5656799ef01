"""What a scene needs of the system, decided on what its masks and poses show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from occfusion.data.sampling import evenly
from occfusion.data.scene_registration import SceneRegistration
from occfusion.human.observability import ObservedSurface
from occfusion.observation.evidence import FITTING
from occfusion.observation.frames import ObservedFrames, misfit_of
from occfusion.observation.light import Light
from occfusion.observation.pose_alignment import Alignment
from occfusion.settings.schema import Settings
from occfusion.settings.stages import AvatarSettings
from occfusion.stages.avatar import BOX_PADDING

AGREED = 0.5
"""Of a lamp's strength: two halves of the body that disagree by more do not tell of one."""
DETERMINED = 50.0
"""Condition up to which the frames tell where a lamp is; embedded scenes have 4 to 8
(docs/experiments/015-key-light.md)."""


TURNED = 33.0
"""Degrees of turning from which the surface is not closed. Embedded people who face the camera within 15 degrees to
both sides have 23 (their limbs turn too), the man of the real clip 13, those who turn half round or more 43: closing
costs exact scenes of those 0.2 dB (docs/experiments/026-surface.md)."""


BOXES_MEASURED = 300
"""Training frames at most, evenly spread, that say how much of the pictures the body's box is."""


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
    settings: Settings, observed_frames: ObservedFrames | None, alignment: Alignment | None = None
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
    if alignment is not None and settings.plan == "needed":
        why = "outlines do not say that poses are off"
        if alignment.is_taken:
            why = "poses are aligned with outlines, and mended frame by frame as far as the video tells"
        left = [replace(d, used=False, reason=f"{d.reason}; {why}") for d in decisions]
        return [left[0], decisions[1], left[2]] if alignment.is_taken else left
    measured = misfit_of(observed_frames)
    if not may_leave_out_networks(settings) or measured is None:
        return decisions
    misfit, count = measured
    shown = (
        f"{misfit:.3%} of the body lies outside the mask (median of {count} frames that show a whole person); "
        f"{FITTING:.2%} would need mending"
    )
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
    return settings.optim.lambda_lpips > 0 and refined.used and may_leave_to_refinement(settings)


def start_decision(settings: Settings) -> Decision:
    """Returns whether there are more Gaussians at the start than the body has vertices.

    Where a refinement follows, that is left to it: it adds them where they are needed.
    """
    asked, reason = settings.optim.gaussians > 0, f"optim.gaussians = {settings.optim.gaussians}"
    added = asked and may_leave_to_refinement(settings) and settings.refine.densify
    reason += "; the refinement adds Gaussians where they are needed" if added else ""
    return Decision("Gaussians between the body's vertices at the start", asked and not added, reason)


def exposure_decision(settings: Settings, light: Light | None) -> Decision:
    """Returns whether training pictures are brought to one exposure: where theirs certainly wanders."""
    part = "evened exposure"
    if settings.exposure == "off":
        return Decision(part, False, "exposure = off; nothing was measured")
    if light is None or light.exposure is None:
        return Decision(part, False, "too little of the body is seen often enough to tell")
    return Decision(part, light.gains is not None, light.exposure.text())


def key_light_decision(settings: Settings, light: Light | None) -> Decision:
    """Returns whether colours change with a lamp: where two halves of the body tell of the same one."""
    part, reason = "key light", f"optim.key_light = {settings.optim.key_light}"
    if not settings.optim.key_light:
        return Decision(part, False, reason)
    if light is None or light.key_light is None:
        return Decision(part, False, f"{reason}; too little of the body is seen often enough to tell")
    reason += (
        f"; a lamp explains {light.key_light.explained:.0%} of how points of the body change as they turn"
    )
    if light.key_light.condition > DETERMINED:
        return Decision(part, False, f"{reason}; the frames do not tell where it is")
    if np.isinf(light.disagreement):
        reason += "; half of the body tells too little of it"
    else:
        reason += f"; two halves of the body differ by {light.disagreement:.0%} on where it is and how strong"
    return Decision(part, light.disagreement <= AGREED or settings.plan == "full", reason)


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
    return Decision(part, is_surface_open(settings, surface.turn), reason)


def is_surface_open(settings: Settings, turn: float) -> bool:
    """Returns whether a video leaves so much of the surface open that it is closed.

    Args:
        settings: of the run.
        turn: of `ObservedSurface`, degrees.
    """
    return turn < TURNED or settings.plan == "full"


def may_leave_out_networks(settings: Settings) -> bool:
    """Returns whether how well poses fit decides on pose refinement and the skinning network."""
    optim = settings.optim
    asked = optim.refine_pose or optim.pose_knots > 0 or optim.learn_skinning
    return asked and settings.plan == "needed"


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


def box_reason(observed_frames: ObservedFrames | None) -> str:
    """Returns how much of the pictures is rendered, where that is known."""
    reason = "rendered crops hold every Gaussian"
    if not observed_frames:
        return reason
    shares = []
    for observed_frame in evenly(observed_frames.judged, BOXES_MEASURED):
        height, width = observed_frame.evidence.hidden.shape
        pixels = observed_frame.projected.pixels
        low = np.clip(pixels.min(axis=0) - BOX_PADDING, 0, (width, height))
        high = np.clip(pixels.max(axis=0) + BOX_PADDING, 0, (width, height))
        shares.append(float(np.prod(high - low)) / (width * height))
    box = f"the body's box is {np.mean(shares):.0%} of the picture"
    return f"{reason}; {box} in the mean of the training frames"


def may_leave_to_refinement(settings: Settings) -> bool:
    """Returns whether parts may go that a refinement makes up for: where one follows, unless all is asked."""
    return "refine" in settings.variant.stages and settings.plan == "needed"
