"""Typed settings: the schema behind `conf/`, checked as a whole before any work starts.

Hydra composes plain YAML; `load_settings` merges it into the dataclasses below, so a wrong type, an unknown
key or a value out of range is an error that names the key and what is allowed.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from occfusion.errors import ConfigError
from occfusion.perceptual import PRECISIONS
from occfusion.priors.distillation import REDUCTIONS, SCHEDULES, WEIGHTINGS
from occfusion.settings.checks import check_in as _check_in
from occfusion.settings.checks import check_range as _check_range
from occfusion.settings.stages import (
    LOGGERS,
    AvatarSettings,
    InitSettings,
    LoggerSettings,
    OptimSettings,
    PriorTrainingSettings,
    RefineSettings,
    SdsSettings,
)

STAGES = ("init", "optim", "refine")
PRIOR_STAGE = "prior"
"""The stage that trains a prior; it has no data set and no avatar."""
PRIORS = ("embedded", "sd15")
PERCEPTUAL_INPUTS = ("centred", "unit")
"""What the evaluation's perceptual metric is fed: -1..1, as it was trained, or 0..1, as GauHuman's family does."""
CAMERA_GAINS = ("none", "camera")
VARIANTS = ("gauhuman", "A", "B", "C", "D", "E")
RECIPES = ("ours", "paper")


@dataclass
class Named:
    """A group whose choice is all there is to set."""

    name: str = ""


@dataclass
class BodySettings:
    """Which body: its family, and the file when it is not the embedded one."""

    name: str = "anny"
    path: str | None = None
    cut_betas: bool = False
    pose_blend_shapes: bool = True


@dataclass
class VariantSettings:
    """A row of the paper's Table 2: the stages it needs, and the paper's own figures."""

    name: str = "A"
    stages: list[str] = field(default_factory=list)
    paper: dict[str, float] = field(default_factory=dict)


@dataclass
class PerceptualSettings:
    """Which perceptual metric, where its backbone lies when no package carries it, and a training term's precision."""

    name: str = "stlpips"
    vgg_path: str | None = None
    precision: str = "float32"


@dataclass
class TrainerSettings:
    """How the Lightning trainer runs."""

    accelerator: str = "auto"
    devices: int = 1
    fast_dev_run: bool = False
    max_steps: int | None = None
    max_time: str | None = None
    checkpoint_every: int = 200
    enable_progress_bar: bool = True


@dataclass
class EvaluationSettings:
    """What is measured after training, and how often during it."""

    held_out: bool = True
    training_views: bool = True
    training_stride: int = 5
    perceptual: bool = True
    perceptual_every: int = 6
    perceptual_inputs: str = "centred"
    camera_gain: str = "none"
    pictures: bool = True
    curve: bool = True
    curve_images: int = 4
    curve_first_second: float = 2.0
    again: bool = False


@dataclass
class Settings:
    """All settings of a run; `dataset` stays a mapping because its reader owns its keys."""

    stage: Named = field(default_factory=Named)
    dataset: dict[str, Any] = field(default_factory=dict)
    body: BodySettings = field(default_factory=BodySettings)
    variant: VariantSettings = field(default_factory=VariantSettings)
    recipe: Named = field(default_factory=Named)
    prior: dict[str, Any] = field(default_factory=dict)
    rasterizer: Named = field(default_factory=Named)
    perceptual: PerceptualSettings = field(default_factory=PerceptualSettings)
    init: InitSettings = field(default_factory=InitSettings)
    optim: OptimSettings = field(default_factory=OptimSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    prior_training: PriorTrainingSettings = field(default_factory=PriorTrainingSettings)
    trainer: TrainerSettings = field(default_factory=TrainerSettings)
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    logger: LoggerSettings = field(default_factory=LoggerSettings)
    optimized_metric: str = "regions.full.psnr"
    speed: Named = field(default_factory=Named)
    registration: str = "auto"
    plan: str = "needed"
    seed: int = 0
    output_dir: str = ""
    shared_dir: str | None = None


def load_settings(config: DictConfig) -> Settings:
    """Returns the composed configuration as typed, checked settings.

    Raises:
        ConfigError: a wrong type, an unknown key, a value out of range, or a choice that does not exist (yet).
    """
    try:
        schema = OmegaConf.structured(Settings)
        # a frozen dataclass would make its node read-only to the merge as well
        for stage in (schema.optim, schema.refine):
            OmegaConf.set_readonly(stage.densification, False)
        # a reference to a whole group has no type of its own: it is followed before the types are checked
        merged = OmegaConf.merge(schema, OmegaConf.to_container(config, resolve=True))
        settings = OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        key = getattr(error, "full_key", None) or "?"
        first_line = str(error).splitlines()[0]
        raise ConfigError(f"setting {key}: {first_line}") from error
    assert isinstance(settings, Settings)
    _check_choices(settings)
    _check_ranges(settings)
    return settings


def settings_hash(settings: Settings) -> str:
    """Returns a short hash of all that decides what training computes."""
    relevant = asdict(settings)
    for key in ("stage", "speed", "recipe", "evaluation", "output_dir", "shared_dir", "prior_training"):
        del relevant[key]
    del relevant["logger"], relevant["optimized_metric"]
    is_distilled = settings.optim.sds.is_used
    if "refine" not in settings.variant.stages:
        del relevant["refine"]
        relevant["prior"].pop("inpaint", None)
    if "init" not in settings.variant.stages:
        del relevant["init"]
        if not is_distilled:  # no prior is asked
            del relevant["prior"]
    if not is_distilled:
        del relevant["optim"]["sds"]
    for key in ("checkpoint_every", "enable_progress_bar"):
        del relevant["trainer"][key]
    del relevant["dataset"]["root"], relevant["variant"]["paper"]
    for key in ("turn", "facing"):  # unset they change nothing: runs from before they existed go on
        if relevant["dataset"].get(key) is None:
            relevant["dataset"].pop(key, None)
    return hashlib.sha256(json.dumps(relevant, sort_keys=True, default=str).encode()).hexdigest()[:16]


def optim_hash(settings: Settings) -> str:
    """Returns a short hash of all that decides the result of the optimisation stage, whatever follows it."""
    stages = [stage for stage in settings.variant.stages if stage != "refine"]
    return settings_hash(replace(settings, variant=VariantSettings("", stages)))


def stages_to_run(settings: Settings) -> list[str]:
    """Returns the stages that this call asks for, in order: those of the variant up to the one named, or all.

    A stage needs the results of those before it; what is done already is not done again.
    """
    if settings.stage.name == PRIOR_STAGE:
        return []
    if settings.stage.name == "all":
        return list(settings.variant.stages)
    stages = list(settings.variant.stages)
    if settings.stage.name not in stages:
        return [settings.stage.name]
    return stages[: stages.index(settings.stage.name) + 1]


def _check_choices(settings: Settings) -> None:
    _check_in("variant.name", settings.variant.name, VARIANTS)
    _check_in("recipe.name", settings.recipe.name, RECIPES)
    _check_in("stage.name", settings.stage.name, ("all", *STAGES, PRIOR_STAGE))
    for stage in stages_to_run(settings):
        if stage not in settings.variant.stages:
            raise ConfigError(
                f"stage={stage}: variant={settings.variant.name} has no such stage; it has "
                f"{', '.join(settings.variant.stages)}"
            )
    if settings.trainer.devices > 1 and "refine" in stages_to_run(settings):
        raise ConfigError(
            f"trainer.devices={settings.trainer.devices}: the refinement stage runs in one process; train up to "
            "variant=D in several, or leave trainer.devices at 1"
        )
    _check_in("prior.name", str(settings.prior.get("name")), PRIORS)
    _check_in("init.source", settings.init.source, ("prior", "truth"))
    _check_in("logger.name", settings.logger.name, LOGGERS)
    _check_in("plan", settings.plan, ("needed", "full"))
    _check_in("registration", settings.registration, ("auto", "off"))
    _check_in("refine.source", settings.refine.source, ("prior", "coarse", "truth"))
    _check_in("refine.gen_pixels", settings.refine.gen_pixels, ("unseen", "hidden"))
    _check_range("optim.mask_hidden", settings.optim.mask_hidden, 0.0, 1.0)
    _check_range("optim.dilation", settings.optim.dilation, 0.01, 1.0)
    _check_range("optim.thickness", settings.optim.thickness, 0.0, 0.05)
    _check_range("refine.mask_hidden", settings.refine.mask_hidden, 0.0, 1.0)
    _check_range("refine.mask_hidden_fitting", settings.refine.mask_hidden_fitting, 0.0, 1.0)
    _check_range("refine.mask_outline", settings.refine.mask_outline, 0.0, 1.0)
    _check_in("refine.mask_target", settings.refine.mask_target, ("outline", "complete"))
    _check_in("refine.lpips_pixels", settings.refine.lpips_pixels, ("visible", "all"))
    _check_in("perceptual.precision", settings.perceptual.precision, PRECISIONS)
    _check_in("evaluation.perceptual_inputs", settings.evaluation.perceptual_inputs, PERCEPTUAL_INPUTS)
    _check_in("evaluation.camera_gain", settings.evaluation.camera_gain, CAMERA_GAINS)
    _check_in("optim.pixels", settings.optim.pixels, ("visible", "all"))
    sds = settings.optim.sds
    _check_in("optim.sds.weighting", sds.weighting, WEIGHTINGS)
    _check_in("optim.sds.schedule", sds.schedule, SCHEDULES)
    _check_in("optim.sds.reduction", sds.reduction, REDUCTIONS)
    _check_in("optim.sds.where", sds.where, ("hidden", "everywhere"))


def _check_ranges(settings: Settings) -> None:
    optim, trainer, evaluation = settings.optim, settings.trainer, settings.evaluation
    for name, stage, terms in (
        ("optim", optim, ("rgb", "mask", "ssim", "lpips")),
        ("refine", settings.refine, ("rgb", "mask", "gen", "ssim", "lpips")),
    ):
        _check_avatar_ranges(name, stage, terms)
    _check_range("init.threshold", settings.init.threshold, 0.0, 1.0)
    _check_range("init.smoothing", settings.init.smoothing, 0.0, 10.0)
    _check_range("optim.gaussians", optim.gaussians, 0, 1_000_000)
    _check_range("optim.pose_knots", optim.pose_knots, 0, 10_000)
    _check_range("optim.skinning_every", optim.skinning_every, 1, 10_000)
    _check_sds_ranges(optim.sds)
    _check_range("seed", settings.seed, 0, 2**32 - 1)
    _check_range("trainer.checkpoint_every", trainer.checkpoint_every, 1, 10_000_000)
    _check_range("trainer.devices", trainer.devices, 1, 1024)
    if trainer.max_steps is not None:
        _check_range("trainer.max_steps", trainer.max_steps, 1, 10_000_000)
    _check_range("logger.every", settings.logger.every, 1, 10_000_000)
    _check_range("logger.pictures_every", settings.logger.pictures_every, 0, 10_000_000)
    _check_range("evaluation.training_stride", evaluation.training_stride, 1, 10_000)
    _check_range("evaluation.perceptual_every", evaluation.perceptual_every, 1, 10_000)
    _check_range("evaluation.curve_images", evaluation.curve_images, 1, 1000)
    _check_range("evaluation.curve_first_second", evaluation.curve_first_second, 0.01, 1e6)


def _check_avatar_ranges(name: str, stage: AvatarSettings, terms: tuple[str, ...]) -> None:
    weights = {f"{name}.lambda_{term}": getattr(stage, f"lambda_{term}") for term in terms}
    for key, value in weights.items():
        _check_range(key, value, 0.0, math.inf)
    if not any(weights.values()):
        raise ConfigError(f"settings {name}.lambda_*: all weights are zero, so there is nothing to train")
    for key, value in vars(stage.rates).items():
        _check_range(f"{name}.rates.{key}", value, 0.0, 10.0)
    _check_range(f"{name}.rates_at_end", stage.rates_at_end, 0.0, 1.0)
    _check_range(f"{name}.steps", stage.steps, 1, 10_000_000)
    _check_range(f"{name}.perceptual_every", stage.perceptual_every, 1, 10_000)
    _check_range(f"{name}.perceptual_crop", stage.perceptual_crop, 32, 2048)
    _check_range(f"{name}.sh_degree", stage.sh_degree, 0, 3)
    _check_range(f"{name}.sh_every", stage.sh_every, 1, 10_000_000)


def _check_sds_ranges(sds: SdsSettings) -> None:
    _check_range("optim.sds.lambda_pose", sds.lambda_pose, 0.0, math.inf)
    _check_range("optim.sds.lambda_can", sds.lambda_can, 0.0, math.inf)
    _check_range("optim.sds.posed_probability", sds.posed_probability, 0.0, 1.0)
    _check_range("optim.sds.t_min", sds.t_min, 0.0, 1.0)
    _check_range("optim.sds.t_max", sds.t_max, sds.t_min, 1.0)
    _check_range("optim.sds.guidance", sds.guidance, 0.0, 1000.0)
    _check_range("optim.sds.every", sds.every, 1, 10_000)
