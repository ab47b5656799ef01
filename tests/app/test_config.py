"""The schema behind conf/: what composes, and what is refused with the key named."""

import math
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException

from occfusion.data.occlusion import OcclusionSettings
from occfusion.errors import ConfigError
from occfusion.human.densify import Densification
from occfusion.settings.names import without_old_names
from occfusion.settings.schema import (
    EvaluationSettings,
    Settings,
    TrainerSettings,
    load_settings,
    settings_hash,
    stages_to_run,
)
from occfusion.settings.stages import InitSettings, OptimSettings, RefineSettings, SdsSettings

CONF = Path(__file__).parents[2] / "conf"


def settings_of(*overrides: str) -> Settings:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return load_settings(compose("config", list(overrides)))


def test_defaults_are_the_papers_numbers() -> None:
    settings = settings_of()
    optim = settings.optim
    assert settings.variant.name == "E"
    assert optim.steps == 1200
    weights = (optim.lambda_rgb, optim.lambda_mask, optim.lambda_ssim, optim.lambda_lpips)
    assert weights == (1e4, 2e4, 1e3, 1e3)
    assert settings.output_dir == "runs/synthetic/001-clean/E"


def test_gauhuman_differs_where_the_paper_says() -> None:
    optim = settings_of("variant=gauhuman").optim
    assert optim.densify
    assert optim.pixels == "all"
    assert optim.lambda_mask < optim.lambda_rgb


def test_dataset_chooses_its_body_and_the_command_line_wins() -> None:
    assert settings_of("dataset=zju").body.name == "smpl"
    assert settings_of("dataset=zju", "body=anny").body.name == "anny"
    assert settings_of().body.name == "anny"


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("optim.lambda_rgb=abc", "optim.lambda_rgb"),
        ("optim.lambda_mask=-1", "optim.lambda_mask"),
        ("optim.lambda_ssim=nan", "optim.lambda_ssim"),
        ("optim.lambda_lpips=inf", "optim.lambda_lpips"),
        ("optim.steps=0", "optim.steps"),
        ("optim.pixels=some", "optim.pixels"),
        ("optim.sh_degree=4", "optim.sh_degree"),
        ("+optim.lamda_rgb=1", "lamda_rgb"),
        ("optim.sds.lambda_pose=-1", "optim.sds.lambda_pose"),
        ("optim.sds.lambda_can=nan", "optim.sds.lambda_can"),
        ("optim.sds.t_max=0.01", "optim.sds.t_max"),
        ("optim.sds.posed_probability=1.2", "optim.sds.posed_probability"),
        ("optim.sds.every=0", "optim.sds.every"),
        ("optim.sds.where=visible", "optim.sds.where"),
        ("optim.sds.reduction=max", "optim.sds.reduction"),
        ("optim.sds.schedule=cosine", "optim.sds.schedule"),
        ("optim.sds.weighting=snr", "optim.sds.weighting"),
        ("refine.references.pixels=visible", "refine.references.pixels"),
        ("refine.references.perceptual=seen", "refine.references.perceptual"),
        ("trainer.max_steps=0", "trainer.max_steps"),
        ("trainer.checkpoint_every=0", "trainer.checkpoint_every"),
        ("seed=-1", "seed"),
    ],
)
def test_bad_value_names_the_setting(override: str, key: str) -> None:
    with pytest.raises(ConfigError, match=key.replace(".", r"\.")):
        settings_of(override)


def test_nothing_to_train_is_refused() -> None:
    zero = [f"optim.lambda_{name}=0" for name in ("rgb", "mask", "ssim", "lpips")]
    with pytest.raises(ConfigError, match="nothing to train"):
        settings_of(*zero)


@pytest.mark.parametrize(
    "overrides", [("variant=F",), ("stage=fit",), ("stage=refine", "variant=D"), ("plan=some",)]
)
def test_what_does_not_exist_is_refused_plainly(overrides: tuple[str, ...]) -> None:
    with pytest.raises(
        (ConfigError, HydraException), match=r"(variant|stage)/(F|fit)|no such stage|setting plan"
    ):
        settings_of(*overrides)


def test_hash_follows_what_training_computes_and_nothing_else() -> None:
    base = settings_hash(settings_of())
    assert settings_hash(settings_of("output_dir=elsewhere", "stage=optim", "dataset.root=/mnt/x")) == base
    assert settings_hash(settings_of("evaluation.pictures=false")) == base
    assert settings_hash(settings_of("dataset.test_cameras=[1]", "dataset.test_frames=[0,4,2]")) == base
    for override in ("optim.lambda_rgb=1", "seed=1", "dataset.occlusion.kind=none", "variant=gauhuman"):
        assert settings_hash(settings_of(override)) != base


def test_speed_presets_train_shorter_and_longer() -> None:
    fast, default, best = (settings_of(f"speed={name}") for name in ("fast", "default", "best"))
    steps = [sum(stage.steps for stage in (s.optim, s.refine)) for s in (fast, default, best)]
    assert steps == sorted(steps) and steps[0] < steps[1] < steps[2]
    assert settings_hash(default) == settings_hash(settings_of())
    assert settings_hash(fast) != settings_hash(default)
    assert settings_hash(fast) == settings_hash(settings_of("speed=fast", "speed.name=default"))
    assert settings_of("speed=fast", "optim.steps=7").optim.steps == 7
    for variant in ("gauhuman", "A", "E"):  # a variant keeps what makes it one
        alike = [settings_of(f"variant={variant}", f"speed={name}").optim for name in ("fast", "default")]
        assert alike[0].lambda_rgb == alike[1].lambda_rgb and alike[0].densify == alike[1].densify
    with pytest.raises(HydraException, match="speed/slow"):
        settings_of("speed=slow")


def test_stage_all_runs_what_the_variant_needs() -> None:
    assert stages_to_run(settings_of()) == ["init", "optim", "refine"]
    assert stages_to_run(settings_of("variant=A")) == ["optim"]
    assert stages_to_run(settings_of("stage=prior")) == []


def test_a_stage_brings_those_before_it() -> None:
    assert stages_to_run(settings_of("stage=optim")) == ["init", "optim"]
    assert stages_to_run(settings_of("stage=init")) == ["init"]
    with pytest.raises(ConfigError, match="variant=A has no such stage"):
        settings_of("stage=init", "variant=A")


def test_a_prior_is_no_part_of_a_run_that_asks_none() -> None:
    for variant in ("gauhuman", "A"):
        base = settings_hash(settings_of(f"variant={variant}"))
        assert settings_hash(settings_of(f"variant={variant}", "prior.seed=3", "init.smoothing=0")) == base
    assert settings_hash(settings_of("prior.seed=3")) != settings_hash(settings_of())


def test_each_variant_has_its_terms_of_score_distillation() -> None:
    for variant, used in {"gauhuman": 0, "A": 0, "B": 0, "C": 1, "D": 2}.items():
        sds = settings_of(f"variant={variant}").optim.sds
        assert (sds.lambda_pose > 0, sds.lambda_can > 0) == (used > 0, used > 1), variant
        assert sds.is_used == (used > 0)


def test_presets_of_score_distillation() -> None:
    measured = settings_of("variant=D").optim.sds
    assert measured == SdsSettings(lambda_pose=measured.lambda_pose, lambda_can=measured.lambda_can)
    paper, code = (settings_of("variant=D", f"sds={name}").optim.sds for name in ("paper", "code"))
    assert (paper.lambda_pose, paper.lambda_can, paper.reduction, paper.where) == (
        2e5,
        2e5,
        "mean",
        "everywhere",
    )
    assert (code.lambda_pose, code.lambda_can, code.reduction, code.schedule) == (20, 20, "sum", "annealed")
    assert settings_of("variant=C", "sds=paper").optim.sds.lambda_can == 0
    assert settings_of("variant=D", "sds=code", "optim.sds.lambda_can=3").optim.sds.lambda_can == 3


def test_refinement_as_in_the_paper_densifies_as_gauhuman_does() -> None:
    """GauHuman counts from the first step on, of which the optimisation takes 1200."""
    densification = settings_of("variant=E", "refine=paper").refine.densification
    assert densification == Densification(after_step=0, before_step=2201 - 1200)


def test_dataclasses_and_files_say_the_same() -> None:
    """Whoever builds settings in Python trains with the numbers that the command line has."""
    composed = settings_of()
    assert composed.optim == OptimSettings()
    assert composed.refine == RefineSettings()
    assert composed.init == InitSettings()
    assert composed.trainer == TrainerSettings()
    assert composed.evaluation == EvaluationSettings()


def test_distillation_is_no_part_of_a_run_without_it() -> None:
    base = settings_hash(settings_of("variant=B"))
    assert settings_hash(settings_of("variant=B", "optim.sds.t_min=0.1", "sds=code")) == base
    distilled = settings_hash(settings_of("variant=C"))
    assert distilled != settings_hash(settings_of("variant=C", "optim.sds.t_min=0.1"))
    assert settings_hash(
        settings_of("variant=A", "optim.sds.lambda_pose=1", "prior.seed=3")
    ) != settings_hash(settings_of("variant=A", "optim.sds.lambda_pose=1"))


def test_numbers() -> None:
    assert not math.isnan(settings_of().optim.lambda_rgb)


@pytest.mark.parametrize("dataset", ["synthetic", "zju", "ocmotion", "video"])
def test_every_dataset_lets_its_occlusion_be_set(dataset: str) -> None:
    settings = settings_of(
        f"dataset={dataset}", "dataset.occlusion.kind=polygons", "dataset.occlusion.seed=3"
    )
    assert settings.dataset.name == dataset
    occlusion = settings.dataset.occlusion
    assert (occlusion.kind, occlusion.seed) == ("polygons", 3)
    defaults = settings_of(f"dataset={dataset}").dataset.occlusion
    assert defaults == OcclusionSettings(defaults.kind)
    assert settings_of(f"dataset={dataset}", "dataset.occlusion=none").dataset.occlusion == OcclusionSettings(
        "none"
    )
    chosen = settings_of(f"dataset={dataset}", "occlusion@dataset.occlusion=none").dataset.occlusion
    assert chosen == OcclusionSettings("none")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("+refine.mask_hidden=1", r"refine\.mask_hidden: has another name now: refine\.hidden\.weight"),
        ("+refine.lambda_gen=1", r"another name now: refine\.references\.weight"),
        ("+optim.sh_frame=world", "no such setting any more"),
        ("+dataset.frmaes=3", r"dataset\.frmaes: unknown; did you mean frames"),
        ("+prior.inpaint.sampels=3", r"prior\.inpaint\.sampels: unknown; did you mean samples"),
        ("dataset.frames=many", r"dataset\.frames='many': expected int"),
        ("prior.draws=0", r"prior\.draws=0: must be at least 1"),
        ("optim.hidden.weight=0.5", r"optim\.hidden\.weight=0\.5: .*choose optim\.hidden\.target=complete"),
        ("optim.hidden.target=outline", "no outline of its own before the refinement"),
    ],
)
def test_old_unknown_and_impossible_settings_are_refused_with_what_to_do(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        settings_of(override)


def test_a_record_of_a_run_from_before_is_read_without_the_names_of_then() -> None:
    kept = without_old_names({"optim": {"mask_hidden": 1.0, "steps": 7, "sds": {"start_step": 0}}, "seed": 1})
    assert kept == {"optim": {"steps": 7, "sds": {}}, "seed": 1}
