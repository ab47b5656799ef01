"""The term that keeps pose corrections small: its value, its effect, and that it is left out without a weight."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from occfusion.stages.avatar import AvatarStage

Train = Callable[..., tuple[Path, dict[str, Any]]]
SHORT = (
    "variant=A",
    "optim.steps=6",
    "optim.rates.pose=0.01",
    "optim.lambda_lpips=0",
    "optim.pose_knots=0",
    "plan=full",
    # round grey Gaussians without a lamp, so that nothing but the poses is to be mended
    "optim.key_light=false",
    "optim.observed_colors=false",
    "optim.thickness=0",
    "optim.dilation=0.3",
    "optim.rates.scales=0.05",
)


def corrections(folder: Path) -> torch.Tensor:
    """What the network answers to the body standing straight, by its weights: an oracle in plain matrices."""
    kept = load_file(folder / "optim" / "avatar.safetensors")
    hidden = torch.zeros(69)
    for layer in (0, 2, 4):
        weight, bias = (kept[f"pose_refiner.layers.{layer}.{part}"] for part in ("weight", "bias"))
        hidden = weight @ hidden + bias
        hidden = hidden if layer == 4 else hidden.clamp(min=0)
    return hidden.view(23, 3)


def used(folder: Path) -> dict[str, bool]:
    return {d["part"]: d["used"] for d in json.loads((folder / "plan.json").read_text())["decisions"]}


def test_a_weight_keeps_corrections_small(train: Train) -> None:
    free, _ = train(*SHORT, "optim.lambda_correction=0", folder="free")
    kept, _ = train(*SHORT, "optim.lambda_correction=1e9", folder="kept")
    assert not used(free)["loss term correction"] and used(kept)["loss term correction"]
    assert corrections(kept).norm() < 0.5 * corrections(free).norm()


def test_the_term_is_the_mean_squared_angle(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[tuple[torch.Tensor, float]] = []
    original = AvatarStage.correction

    def watched(self: AvatarStage, frame: Any) -> dict[str, torch.Tensor]:
        terms = original(self, frame)
        assert self.avatar.pose_refiner is not None
        angles = self.avatar.pose_refiner.layers(frame.pose.body_pose.float()).detach().double().view(23, 3)
        found.append((angles, float(terms["correction"].detach())))
        return terms

    monkeypatch.setattr(AvatarStage, "correction", watched)
    train(*SHORT, "optim.lambda_correction=1")
    assert len(found) == 6
    for angles, value in found:
        assert value == pytest.approx(sum(float(row @ row) for row in angles) / 23, rel=1e-5)
    assert found[-1][1] > found[0][1]


def test_corrections_frame_by_frame_count_too(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[tuple[float, float]] = []
    original = AvatarStage.correction

    def watched(self: AvatarStage, frame: Any) -> dict[str, torch.Tensor]:
        terms = original(self, frame)
        assert self.avatar.pose_refiner is None and self.avatar.pose_spline is not None
        turns = self.avatar.pose_spline.at(frame.pose.moment)[0].detach().double()
        found.append((sum(float(row @ row) for row in turns) / 24, float(terms["correction"].detach())))
        return terms

    monkeypatch.setattr(AvatarStage, "correction", watched)
    asked = ("optim.refine_pose=false", "optim.pose_knots=2", "optim.lambda_correction=1")
    train(*SHORT, *asked, "optim.rates.pose_turns=0.01")
    assert len(found) == 6
    for wanted, value in found:
        assert value == pytest.approx(wanted, rel=1e-5)
    assert found[-1][1] > found[0][1] == 0.0


@pytest.mark.parametrize("without", ["optim.lambda_correction=0", "optim.refine_pose=false"])
def test_without_weight_or_corrections_nothing_is_built(
    train: Train, without: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = AvatarStage.correction

    def empty(self: AvatarStage, frame: Any) -> dict[str, torch.Tensor]:
        terms = original(self, frame)
        assert terms == {}
        return terms

    monkeypatch.setattr(AvatarStage, "correction", empty)
    folder, _ = train(*SHORT, "optim.lambda_correction=1", without)
    assert not used(folder)["loss term correction"]
