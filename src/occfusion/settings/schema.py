"""Typed settings: the schema behind `conf/`, checked as a whole before any work starts.

Hydra composes plain YAML; `load_settings` reads it into the dataclasses below, so a wrong type, an unknown name or a
value out of range is an error that names the setting and says what is allowed.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from occfusion.errors import ConfigError
from occfusion.fields import check_choice, read_record, setting
from occfusion.files.run_folder import STAGES
from occfusion.perceptual import PRECISIONS
from occfusion.settings.datasets import DATASETS, DatasetSettings, SyntheticSettings
from occfusion.settings.names import dotted, refuse_old_names
from occfusion.settings.priors import PRIORS, EmbeddedPriorSettings, PriorSettings
from occfusion.settings.stages import (
    MANY,
    AvatarSettings,
    InitSettings,
    LoggerSettings,
    OptimSettings,
    PriorTrainingSettings,
    RefineSettings,
)

HELD_OUT_SETTINGS = ("test_cameras", "test_frames")
"""Of a data set: what is measured on, which changes nothing that training computes."""
PRIOR_STAGE = "prior"
"""The stage that trains a prior; it has no data set and no avatar."""
LEAST_SEEN = 300
"""Training frames that are looked at however few the steps are: what is measured of a video looks at up to 240."""


@dataclass
class Named:
    """A group whose choice is all there is to set."""

    name: str = ""


@dataclass
class StageChoice(Named):
    """Which stage runs."""

    name: str = setting("all", "the stage", choices=("all", *STAGES, PRIOR_STAGE))


@dataclass
class RecipeChoice(Named):
    """Whose numbers."""

    name: str = setting("ours", "whose numbers", choices=("ours", "paper"))


@dataclass
class RasterizerChoice(Named):
    """Which backend rasterises."""

    name: str = setting("auto", "the backend", choices=("auto", "torch", "numba", "gsplat"))


@dataclass
class BodySettings:
    """Which body: its family, and the file when it is not the embedded one."""

    name: str = setting("anny", "the family", choices=("anny", "smpl"))
    path: str | None = setting(None, "a file of the SMPL family: .npz, .safetensors, or the official .pkl")
    cut_betas: bool = setting(
        False,
        "leave out shape numbers in the data that the file has no components for (AMASS has 16, SMPL 1.0 has 10)",
    )
    pose_blend_shapes: bool = setting(
        True,
        "false: leave out the file's pose blend shapes, for parameters that were fitted without them (ZJU-MoCap's "
        "params/)",
    )


@dataclass
class VariantSettings:
    """A row of the paper's Table 2: the stages it needs, and the paper's own figures."""

    name: str = setting("A", "the row", choices=("gauhuman", "A", "B", "C", "D", "E"))
    stages: list[str] = setting([], "those that it needs, in order", choices=STAGES)
    paper: dict[str, float] = setting({}, "the paper's own figures")


@dataclass
class PerceptualSettings:
    """Which perceptual metric, where its backbone lies when no package carries it, and a training term's precision."""

    name: str = setting("stlpips", "the metric", choices=("stlpips", "lpips"))
    vgg_path: str | None = setting(None, "the file of the backbone, of lpips alone")
    precision: str = setting(
        "auto", "of the network in a training term; figures are of float32 always", choices=PRECISIONS
    )


@dataclass
class TrainerSettings:
    """How the Lightning trainer runs."""

    accelerator: str = setting("auto", "as in Lightning", choices=("auto", "cpu", "gpu", "cuda"))
    devices: int = setting(
        1, "processes, each with a GPU or a CPU's cores, that train this scene together", 1, 1024
    )
    fast_dev_run: bool = setting(False, "true: one step and one image, to see that it works")
    max_steps: int | None = setting(None, "of each stage; null: what the stage's own settings say", 1, MANY)
    max_time: str | None = setting(None, 'of each stage, days:hours:minutes:seconds, e.g. "00:00:03:00"')
    checkpoint_every: int = setting(200, "steps from one checkpoint to the next", 1, MANY)
    enable_progress_bar: bool = setting(True, "a line with terms, speed and time left")


@dataclass
class EvaluationSettings:
    """What is measured after training, and how often during it."""

    held_out: bool = setting(
        True, "the test cameras: regions `full`, `box`, `seen_many`, `seen_one` and `unseen`"
    )
    training_views: bool = setting(True, "the training camera: regions `visible` and `hidden`")
    training_stride: int = setting(5, "every k-th training view", 1, 10_000)
    perceptual: bool = setting(True, "whether the perceptual metric is computed at all")
    perceptual_every: int = setting(
        6, "the perceptual metric of every k-th held-out image: it costs more than all the rest", 1, 10_000
    )
    perceptual_inputs: str = setting(
        "centred",
        "what the metric is fed: `centred`: -1..1, as the metrics were trained; `unit`: 0..1, GauHuman's call",
        choices=("centred", "unit"),
    )
    camera_gain: str = setting(
        "none",
        "`camera`: colours of each held-out camera times a gain a channel, least squares over the person",
        choices=("none", "camera"),
    )
    pictures: bool = setting(True, "truth, rendering and error side by side")
    turntable: int = setting(
        60, "pictures of a turn around the avatar, with a strip of video above avatar; 0: neither", 0, 1000
    )
    curve: bool = setting(True, "error_vs_time.csv on a fixed handful of held-out images")
    curve_images: int = setting(4, "how many that handful has", 1, 1000)
    curve_first_second: float = setting(
        2.0, "of training at which it begins; then at twice the time, and so on", 0.01, 1e6
    )
    again: bool = setting(False, "true: also when this very run was trained and evaluated before")


@dataclass
class Settings:
    """All settings of a run."""

    stage: StageChoice = field(default_factory=StageChoice)
    dataset: DatasetSettings = field(default_factory=SyntheticSettings)
    body: BodySettings = field(default_factory=BodySettings)
    variant: VariantSettings = field(default_factory=VariantSettings)
    recipe: RecipeChoice = field(default_factory=RecipeChoice)
    prior: PriorSettings = field(default_factory=EmbeddedPriorSettings)
    rasterizer: RasterizerChoice = field(default_factory=RasterizerChoice)
    perceptual: PerceptualSettings = field(default_factory=PerceptualSettings)
    init: InitSettings = field(default_factory=InitSettings)
    optim: OptimSettings = field(default_factory=OptimSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    prior_training: PriorTrainingSettings = field(default_factory=PriorTrainingSettings)
    trainer: TrainerSettings = field(default_factory=TrainerSettings)
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    logger: LoggerSettings = field(default_factory=LoggerSettings)
    optimized_metric: str = setting(
        "regions.full.psnr", "of metrics.json: what the job returns to a sweeper of Hydra's"
    )
    speed: Named = field(default_factory=Named)
    registration: str = setting(
        "auto",
        "auto: cameras are corrected where pictures are certainly shifted or scaled against them; off",
        choices=("auto", "off"),
    )
    exposure: str = setting(
        "auto",
        "auto: training pictures are brought to one exposure where theirs certainly wanders; off",
        choices=("auto", "off"),
    )
    plan: str = setting(
        "needed",
        "needed: what the scene does not need is left out (plan.json); full: everything is done",
        choices=("needed", "full"),
    )
    seed: int = setting(
        0, "of sampling, crops and networks; what is hidden has a seed of its own", 0, 2**32 - 1
    )
    output_dir: str = setting("", "the run folder")
    shared_dir: str | None = setting(
        None, "results that variants share (masks of the initialisation); null: .shared beside output_dir"
    )


def load_settings(config: DictConfig | dict[str, Any]) -> Settings:
    """Returns the composed configuration as typed, checked settings.

    Raises:
        ConfigError: a wrong type, an unknown name, one that a setting had once, a value out of range, or a choice that
            does not exist.
    """
    try:
        content = OmegaConf.to_container(
            config if isinstance(config, DictConfig) else OmegaConf.create(config), resolve=True
        )
    except OmegaConfBaseException as error:
        key = getattr(error, "full_key", None) or "?"
        raise ConfigError(f"setting {key}: {str(error).splitlines()[0]}") from error
    assert isinstance(content, dict)
    given = {str(key): value for key, value in content.items()}
    refuse_old_names(dotted(given))
    for group, records in (("dataset", DATASETS), ("prior", PRIORS)):
        if isinstance(own := given.get(group), dict):
            name = str(own.get("name"))
            check_choice(f"{group}.name", name, tuple(records))
            given[group] = read_record(records[name], own, group)
    settings = read_record(Settings, given)
    for stage in ("optim", "refine"):
        getattr(settings, stage).check(stage)
    _check_stages(settings)
    limit = settings.trainer.max_time
    if limit is not None and re.fullmatch(r"\d+:\d{1,2}:\d{1,2}:\d{1,2}", limit) is None:
        raise ConfigError(
            f'setting trainer.max_time={limit!r}: must be "days:hours:minutes:seconds", e.g. "00:00:03:00"'
        )
    return settings


def known_settings() -> set[str]:
    """Returns the dotted names of all settings, of every data set and prior."""
    records = [Settings(), *(Settings(dataset=kind()) for kind in DATASETS.values())]
    records += [Settings(prior=kind()) for kind in PRIORS.values()]
    return {key for record in records for key in dotted(asdict(record))}


def _check_stages(settings: Settings) -> None:
    """Refuses stages that the variant has not, or that cannot run so."""
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
    completion = relevant.get("prior", {}).pop("completion", None)
    if settings.optim.unseen_colors != "nearest":
        relevant["completion"] = completion
    if not is_distilled:
        del relevant["optim"]["sds"]
    for key in ("checkpoint_every", "enable_progress_bar"):
        del relevant["trainer"][key]
    del relevant["dataset"]["root"], relevant["variant"]["paper"]
    for key in HELD_OUT_SETTINGS:
        relevant["dataset"].pop(key, None)
    for key in ("turn", "facing"):  # unset they change nothing: runs from before they existed go on
        if relevant["dataset"].get(key) is None:
            relevant["dataset"].pop(key, None)
    for stage in {"optim", "refine"} & relevant.keys():  # likewise
        rule = relevant[stage].get("densification", {})
        if rule.get("narrower") == 1.0:
            del rule["narrower"]
    return hashlib.sha256(json.dumps(relevant, sort_keys=True, default=str).encode()).hexdigest()[:16]


def optim_hash(settings: Settings) -> str:
    """Returns a short hash of all that decides the result of the optimisation stage, whatever follows it."""
    stages = [stage for stage in settings.variant.stages if stage != "refine"]
    return settings_hash(replace(settings, variant=VariantSettings("", stages)))


def stages_to_run(settings: Settings) -> list[str]:
    """Returns the stages that this call asks for, in order: those of the variant up to the one named, or all.

    A stage needs the results of those before it; what is done already is not done again.
    """
    asked, stages = settings.stage.name, list(settings.variant.stages)
    if asked == PRIOR_STAGE:
        return []
    if asked == "all":
        return stages
    return stages[: stages.index(asked) + 1] if asked in stages else [asked]


def steps_of(settings: Settings, stage: AvatarSettings) -> int:
    """Returns the steps that a stage takes."""
    return stage.steps if settings.trainer.max_steps is None else settings.trainer.max_steps


def most_seen(settings: Settings) -> int | None:
    """Returns how many training frames steps see at most; None where all are to be looked at.

    Each step of the optimisation sees one, and each process has its own; later stages take of these.
    """
    if settings.plan == "full":
        return None
    return max(LEAST_SEEN, steps_of(settings, settings.optim) * settings.trainer.devices)
