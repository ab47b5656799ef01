"""Variants C and D on a tiny scene: what their terms do, and that nothing is loaded where they have no weight."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from occfusion.errors import NumericsError
from occfusion.priors.embedded.silhouette_prior import EmbeddedScore
from occfusion.run import optim as optim_run
from occfusion.run import prepare
from occfusion.stages.distil import Distiller

Train = Callable[..., tuple[Path, dict[str, Any]]]
SHORT = "optim.steps=6"


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, str, float]]:
    """What each step distils: step, term, value."""
    found: list[tuple[int, str, float]] = []
    original = Distiller.terms

    def recorded(self: Distiller[Any], *args: Any) -> dict[str, torch.Tensor]:
        terms = original(self, *args)
        found.extend((args[-1], name, float(value.detach())) for name, value in terms.items())
        return terms

    monkeypatch.setattr(Distiller, "terms", recorded)
    return found


def opacities(folder: Path) -> torch.Tensor:
    return load_file(folder / "optim" / "avatar.safetensors")["gaussians.opacity_logits"]


def used(folder: Path, part: str) -> bool:
    (decision,) = (
        d for d in json.loads((folder / "plan.json").read_text())["decisions"] if d["part"] == part
    )
    return bool(decision["used"])


def test_variants_distil_what_they_say(train: Train, calls: list[tuple[int, str, float]]) -> None:
    b, _ = train("variant=B", SHORT, folder="b")
    assert calls == []
    c, _ = train("variant=C", SHORT, folder="c")
    posed = list(calls)
    assert posed and {name for _, name, _ in posed} == {"sds_pose"}
    d, _ = train("variant=D", SHORT, "optim.sds.posed_probability=0.5", folder="d")
    assert {name for _, name, _ in calls[len(posed) :]} == {"sds_pose", "sds_can"}
    assert not torch.equal(opacities(b), opacities(c))
    assert not torch.equal(opacities(c), opacities(d))
    assert [used(folder, "loss term sds_pose") for folder in (b, c, d)] == [False, True, True]
    assert [used(folder, "loss term sds_can") for folder in (b, c, d)] == [False, False, True]


@pytest.mark.slow
def test_the_whole_system_leaves_it_out_where_masks_are_complete(
    train: Train,
    calls: list[tuple[int, str, float]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Then `E` goes on from the very avatar of `B`; `plan=full`, or a frame that shows little, brings it back.

    As long as both its stages have the terms of `B`: neither deferred perceptual ones nor masks that count less, nor
    Gaussians that are left to the refinement.
    """
    alike = ("refine.lambda_lpips=0", "refine.hidden.target=complete", "refine.densify=false")
    refine = ("variant=E", SHORT, "refine.steps=1", "refine.references.source=coarse", *alike)
    train("variant=B", SHORT, folder="b")
    with monkeypatch.context() as patch:
        patch.setattr(prepare, "check_score_prior", lambda *_: pytest.fail("it is not needed"))
        _, metrics = train(*refine, folder="e")
    assert calls == [] and "optim: trained before" in capsys.readouterr().out
    assert {"loss term sds_pose", "loss term sds_can"} <= set(metrics["left_out"])
    train(*refine, "plan=full", folder="full")
    assert calls
    calls.clear()
    monkeypatch.setattr("occfusion.plan.hidden.MOSTLY_HIDDEN", 0.01)
    train(*refine, folder="hidden")
    assert calls


def test_terms_come_when_the_settings_say(train: Train, calls: list[tuple[int, str, float]]) -> None:
    train("variant=D", SHORT, "optim.sds.every=2", "optim.sds.posed_probability=0")
    assert [(step, name) for step, name, _ in calls] == [(0, "sds_can"), (2, "sds_can"), (4, "sds_can")]


@pytest.mark.parametrize("variant", ["gauhuman", "A", "B"])
def test_without_weight_nothing_is_built(train: Train, variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: Any) -> None:
        raise AssertionError("built for a weight of zero")

    monkeypatch.setattr(optim_run, "make_score_prior", refused)
    monkeypatch.setattr(Distiller, "__init__", refused)
    monkeypatch.setattr(EmbeddedScore, "__init__", refused)
    recipe = "ours"
    if (
        variant == "gauhuman"
    ):  # as published it asks nothing of the frames; the others judge how well poses fit
        recipe = "paper"
        monkeypatch.setattr(prepare, "observe_training_frames", refused)
    for library in ("diffusers", "transformers"):
        monkeypatch.setitem(sys.modules, library, None)
    folder, _ = train(f"variant={variant}", f"recipe={recipe}", "trainer.fast_dev_run=true")
    assert not used(folder, "loss term sds_pose")


def test_whole_people_leave_nothing_to_push(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optim_run, "make_score_prior", lambda *_: pytest.fail("no frame hides anything"))
    folder, _ = train("variant=C", "trainer.fast_dev_run=true", "dataset.occlusion.kind=none")
    decisions = json.loads((folder / "plan.json").read_text())["decisions"]
    (reason,) = (d["reason"] for d in decisions if d["part"] == "loss term sds_pose")
    assert "0 of 10 training frames have hidden pixels" in reason


def test_variant_without_masks_can_distil_as_well(train: Train, calls: list[tuple[int, str, float]]) -> None:
    train("variant=A", SHORT, "optim.sds.lambda_pose=1e5")
    assert calls


def test_score_that_is_not_finite_stops_and_keeps_the_last_good_state(
    train: Train, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    original, asked = EmbeddedScore.predict_noise, []

    def fails_at_the_third(self: EmbeddedScore, *args: Any) -> torch.Tensor:
        asked.append(1)
        value = original(self, *args)
        return value / 0.0 if len(asked) == 3 else value

    options = (
        "variant=C",
        SHORT,
        "optim.sds.posed_probability=1",
        "dataset.occlusion.fraction=1",
        "optim.sds.every=1",
    )
    whole, _ = train(*options, folder="whole")
    options = (
        *options,
        f"shared_dir={tmp_path / 'apart'}",
    )  # or the whole run's optimisation would be taken over
    with monkeypatch.context() as patch:
        patch.setattr(EmbeddedScore, "predict_noise", fails_at_the_third)
        with pytest.raises(
            NumericsError, match=r"step 2, frame \S+: the score of prior embedded is not finite"
        ):
            train(*options)
    folder, _ = train(*options)
    assert torch.equal(opacities(folder), opacities(whole))


def test_forgotten_views_are_made_again_alike(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    options = ("variant=D", SHORT)
    kept, _ = train(*options, folder="kept")
    monkeypatch.setattr("occfusion.stages.distil.KEPT_VIEWS", 1)
    forgotten, _ = train(*options, folder="forgotten")
    assert torch.equal(opacities(kept), opacities(forgotten))
