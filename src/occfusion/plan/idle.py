"""Settings that the user gave and that change nothing in this run, each with why."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from occfusion.data.occlusion import OcclusionSettings, zju_subject
from occfusion.files.run_folder import STAGES
from occfusion.plan.make import Plan, reached_sh_degree, refined_sh_degree
from occfusion.settings.schema import PRIOR_STAGE, Settings
from occfusion.settings.stages import OptimSettings

SHAPES_OF_OCCLUSION = ("fraction", "mid", "width", "share", "seed", "folder")
"""Settings of `dataset.occlusion` that say how a picture is hidden, not whether."""


def idle_settings(given: Iterable[str], settings: Settings, plan: Plan) -> list[str]:
    """Returns a line for each setting that was given and decides nothing in this run.

    Args:
        given: overrides as typed, `name=value`.
        settings: as the user asked, with these in them.
        plan: what the run does.
    """
    rules = list(_rules(settings, plan))
    told = []
    for word in given:
        key, _, value = word.lstrip("+~").partition("=")
        if "." not in key:  # a choice of a group, which sets what the user may not have thought of
            continue
        reasons = (why for prefix, why in rules if key == prefix or key.startswith(f"{prefix}."))
        if (why := next(reasons, None)) is not None:
            told.append(f"{key}={value}: {why}")
    return told


def _rules(settings: Settings, plan: Plan) -> Iterator[tuple[str, str]]:
    """Yields names, or the groups that they begin with, and why they decide nothing; the most telling first."""
    reasons = {decision.part: decision.reason for decision in plan.decisions if not decision.used}
    for stage in STAGES:
        if stage not in plan.stages:
            why = reasons.get(f"stage {stage}", "it is not asked for")
            yield stage, f"the stage does not run; {why}"
    if settings.trainer.max_steps is not None:
        for stage in ("optim", "refine"):
            yield f"{stage}.steps", f"trainer.max_steps={settings.trainer.max_steps} stands in its place"
    for stage in ("optim", "refine"):
        yield from _of_stage(stage, settings, plan, reasons)
    optim = plan.settings.optim
    if not optim.sds.is_used:
        why = reasons.get("loss term sds_pose", reasons.get("loss term sds_can", "its weights are 0"))
        yield "optim.sds", f"no score is distilled; {why}"
    else:
        for name in ("pose", "can"):
            left_out = reasons.get(f"loss term sds_{name}")
            if left_out and getattr(settings.optim.sds, f"lambda_{name}"):
                yield f"optim.sds.lambda_{name}", left_out
    yield from _of_prior(settings, plan)
    occlusion = settings.dataset.occlusion
    if occlusion.kind == "none" or _hides_nothing(occlusion, str(settings.dataset.scene)):
        why = "nothing is hidden: a share, a fraction or a width is 0"
        if occlusion.kind == "none":
            why = "dataset.occlusion.kind=none hides nothing"
        for name in SHAPES_OF_OCCLUSION:
            yield f"dataset.occlusion.{name}", why
    if not settings.evaluation.perceptual:
        for name in ("perceptual_every", "perceptual_inputs"):
            yield f"evaluation.{name}", "evaluation.perceptual=false"
    if not settings.evaluation.curve:
        for name in ("curve_images", "curve_first_second"):
            yield f"evaluation.{name}", "evaluation.curve=false"
    yield "prior_training", f"stage={PRIOR_STAGE} alone reads it"


def _hides_nothing(occlusion: OcclusionSettings, scene: str) -> bool:
    """Returns whether a simulated occlusion has no extent, or no frame."""
    if occlusion.kind == "files":
        return False
    if occlusion.until == 0 or (occlusion.until is None and occlusion.fraction == 0):
        return True
    if occlusion.kind in ("strip", "moving") and occlusion.width is not None:
        return occlusion.width == 0
    has_own_columns = occlusion.kind == "strip" and zju_subject(scene) is not None  # of the paper's table
    return occlusion.share == 0 and not has_own_columns


def _of_stage(
    stage: str, settings: Settings, plan: Plan, reasons: dict[str, str]
) -> Iterator[tuple[str, str]]:
    asked, planned = getattr(settings, stage), getattr(plan.settings, stage)
    where = "" if stage == "optim" else f" in {stage}"
    if not planned.densify:
        part = "densification" if stage == "optim" else "densification in the refinement"
        why = reasons.get(part, f"{stage}.densify = {asked.densify}")
        yield f"{stage}.densification", f"nothing is densified; {why}"
    elif not planned.densification.divide:
        why = f"no Gaussian is divided; {stage}.densification.divide = False"
        yield f"{stage}.densification.narrower", why
    if not planned.lambda_ssim:
        yield f"{stage}.ssim_margin", f"the stage has no structural term; {stage}.lambda_ssim = 0"
    if not planned.lambda_lpips:
        why = reasons.get(f"loss term lpips{where}", f"{stage}.lambda_lpips = 0")
        for name in ("perceptual_every", "perceptual_from", "perceptual_crop"):
            yield f"{stage}.{name}", f"the stage has no perceptual term; {why}"
        if asked.lambda_lpips:
            yield f"{stage}.lambda_lpips", why
    if not planned.surface.is_used:
        why = reasons.get(f"surface prior{where}", "its weights are 0")
        yield f"{stage}.surface", f"no surface is closed; {why}"
    reached = reached_sh_degree(settings) if stage == "optim" else refined_sh_degree(settings)
    if asked.sh_degree > reached:
        yield f"{stage}.sh_degree", f"degree {reached} is the highest that its steps reach"
    if reached == 0:
        yield f"{stage}.rates.sh_rest", "no band above the first is reached"
    if isinstance(planned, OptimSettings):
        yield from _of_networks(settings, planned, reasons)


def _of_networks(
    settings: Settings, planned: OptimSettings, reasons: dict[str, str]
) -> Iterator[tuple[str, str]]:
    for is_used, part, names in (
        (planned.refine_pose, "pose refinement", ("refine_pose", "rates.pose")),
        (
            planned.pose_knots, "pose corrections frame by frame",
            ("pose_knots", "rates.pose_turns", "rates.pose_places"),
        ),
        (planned.learn_skinning, "skinning network", ("learn_skinning", "skinning_every", "rates.skinning")),
    ):  # fmt: skip
        if is_used:
            continue
        for name in names:
            if getattr(settings.optim, name, True):  # what was turned off is off, as asked
                yield f"optim.{name}", f"left out: {reasons.get(part, 'turned off')}"
    if settings.optim.key_light and not planned.key_light:
        yield "optim.key_light", f"no lamp; {reasons.get('key light', 'none was found')}"


def _of_prior(settings: Settings, plan: Plan) -> Iterator[tuple[str, str]]:
    optim = plan.settings.optim
    masks = "init" in plan.stages and settings.init.source == "prior"
    paints = plan.inpaints and plan.settings.refine.references.source == "prior"
    completes = optim.unseen_colors == "prior"
    if not plan.inpaints:
        yield "refine.references", "no frame is inpainted"
    if not completes:
        yield "prior.completion", "no colours are completed"
    if not paints:
        yield "prior.inpaint", "no picture is inpainted by a prior"
    if not (masks or paints or completes or optim.sds.is_used):
        yield "prior", "no prior is asked"
