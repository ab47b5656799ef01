"""A setting that can do nothing is named with the reason; one that does something is not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from app.conftest import CONF
from app.test_config import settings_of
from app.test_plan import frames, made
from occfusion.cli.train import main
from occfusion.plan.idle import idle_settings

OCCLUDED = frames(*[0.5] * 6, *[0.0] * 6)


def told(*overrides: str, shares: list[float] | None = None) -> str:
    settings = settings_of(*overrides)
    plan = made(settings, OCCLUDED if shares is None else frames(*shares))
    return "\n".join(idle_settings(overrides, settings, plan))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("variant=A", "refine.steps=99"), "refine.steps=99: the stage does not run; variant A does not need it"),
        (("variant=A", "refine.rates.sh0=1e-3"), "refine.rates.sh0=1e-3: the stage does not run"),
        (("variant=A", "init.threshold=0.4"), "init.threshold=0.4: the stage does not run"),
        (("stage=optim", "refine.steps=9"), "stage=optim asks for another"),
        (("variant=A", "prior.inpaint.weights=x"), "no picture is inpainted by a prior"),
        (("variant=B", "optim.sds.t_min=0.3"), "optim.sds.t_min=0.3: no score is distilled; optim.sds.lambda_pose = 0"),
        (("variant=E", "optim.sds.every=3"), "it changed nothing then"),
        (("variant=E", "optim.lambda_lpips=5"), "the refinement that follows has it"),
        (("variant=E", "optim.perceptual_every=2"), "the stage has no perceptual term"),
        (("optim.densification.every=50",), "nothing is densified; optim.densify = False"),
        (("variant=E", "trainer.max_steps=90", "refine.densification.gradient=1e-3"),
         "no round falls into 90 steps"),
        (("variant=E", "refine.densification.divide=false", "refine.densification.narrower=1.2"),
         "no Gaussian is divided; refine.densification.divide = False"),
        (("trainer.max_steps=50", "optim.steps=70"), "optim.steps=70: trainer.max_steps=50 stands in its place"),
        (("optim.sh_degree=3", "optim.steps=1100"), "degree 1 is the highest that its steps reach"),
        (("optim.steps=900", "optim.rates.sh_rest=1e-3", "variant=A"), "no band above the first is reached"),
        (("optim.refine_pose=false", "optim.rates.pose=1e-3"), "optim.rates.pose=1e-3: left out"),
        (("optim.learn_skinning=false", "optim.skinning_every=2"), "optim.skinning_every=2: left out"),
        (("dataset.occlusion.kind=none", "dataset.occlusion.share=0.4"), "kind=none hides nothing"),
        (("dataset.occlusion.kind=strip", "dataset.occlusion.share=0"), "share=0: nothing is hidden"),
        (("dataset.occlusion.kind=box", "dataset.occlusion.fraction=0"), "fraction=0: nothing is hidden"),
        (("dataset.occlusion.kind=moving", "dataset.occlusion.width=0"), "width=0: nothing is hidden"),
        (("evaluation.perceptual=false", "evaluation.perceptual_every=2"), "evaluation.perceptual=false"),
        (("evaluation.curve=false", "evaluation.curve_images=2"), "evaluation.curve=false"),
        (("prior_training.steps=3",), "stage=prior alone reads it"),
    ],
)  # fmt: skip
def test_named_with_the_reason(overrides: tuple[str, ...], words: str) -> None:
    found = told(*overrides)
    assert words in found and len(found.splitlines()) == 1, found


@pytest.mark.parametrize(
    "overrides",
    [
        ("variant=A", "optim.steps=99", "optim.rates.means=1e-4", "optim.hidden.target=none", "seed=3"),
        ("variant=E", "refine.steps=99", "refine.densification.every=50", "init.threshold=0.4"),
        ("variant=D", "optim.sds.t_min=0.3", "optim.sds.lambda_can=5", "prior.score.guidance=2"),
        ("optim.densify=true", "optim.densification.every=50"),
        (
            "optim.refine_pose=false",
            "optim.learn_skinning=false",
            "optim.pose_knots=0",
            "optim.surface.hold=false",
        ),
        ("dataset.occlusion.kind=box", "dataset.occlusion.share=0.4"),
        ("dataset.occlusion.kind=strip", "dataset.occlusion.share=0", "dataset.occlusion.width=100"),
    ],
)
def test_what_does_something_is_not_named(overrides: tuple[str, ...]) -> None:
    known = [word for word in overrides if not word.startswith(("prior.score", "optim.surface"))]
    assert told(*known) == ""


@pytest.mark.slow
def test_the_command_says_so_before_it_trains(
    scene_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = scene_root / "001-clean"
    arguments = [
        "dataset=zju", f"dataset.root={scene_root}", "dataset.scene=001-clean", f"body.path={scene / 'body.npz'}",
        "variant=gauhuman", "trainer.fast_dev_run=true", "trainer.accelerator=cpu", f"output_dir={tmp_path / 'run'}",
        "refine.steps=5", "optim.lambda_lpips=0", "evaluation.perceptual=false",
    ]  # fmt: skip
    assert main(CONF, arguments) == 0
    said = capsys.readouterr().out
    line = "refine.steps=5: the stage does not run; variant gauhuman does not need it"
    assert f"settings that change nothing in this run\n  {line}" in said
    assert said.index(line) < said.index("plan\n")
    assert json.loads((tmp_path / "run" / "plan.json").read_text())["idle"] == [line]
