"""What the optimisation's Gaussians start with."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from occfusion.data.sampling import spread
from occfusion.human.rendering import Renderer
from occfusion.observation.clothes import measure_clothes
from occfusion.run import prepare
from occfusion.run.loaded import load_run
from occfusion.run.prepare import make_body, make_data

Train = Callable[..., tuple[Path, dict[str, Any]]]
STILL = ("optim.steps=1", "optim.rates.sh0=0", "optim.key_light=false", "optim.gaussians=0", "stage=optim")


def start_of(folder: Path) -> torch.Tensor:
    colors: torch.Tensor = load_file(folder / "optim" / "avatar.safetensors")["gaussians.sh0"]
    return colors


def error_of(folder: Path) -> float:
    """Mean absolute difference to the seen pixels of all training frames, of a nearly opaque avatar."""
    found = load_run(folder)
    data = make_data(found.settings, make_body(found.settings.body))
    data.setup()
    found.avatar.gaussians.opacity_logits.data.fill_(3.0)
    errors = []
    for k in range(len(data.train_indices)):
        frame = data.train_frame(k)
        made = Renderer("torch").frame(found.avatar, frame)
        inside = frame.visible_mask & (made.alpha > 0.9)
        errors.append((made.rgb - frame.rgb)[inside].abs().mean())
    return float(torch.stack(errors).mean())


def test_the_whole_system_starts_with_the_colours_of_the_video(train: Train) -> None:
    folder, metrics = train("variant=E", *STILL)
    plan = {d["part"]: d for d in json.loads((folder / "plan.json").read_text())["decisions"]}
    assert plan["colours of the video at the start"]["used"]
    assert metrics["train_seconds"]["optim"] > 0
    assert (start_of(folder).abs().amax(dim=2) > 1e-3).all(), "none is left grey"
    grey, _ = train("variant=E", *STILL, "optim.observed_colors=false", folder="grey")
    assert error_of(folder) < 0.05 < 0.15 < error_of(grey)


def test_the_paper_starts_grey(train: Train, capsys: pytest.CaptureFixture[str]) -> None:
    """And another number of Gaussians than was asked for is said."""
    folder, _ = train("variant=A", "recipe=paper", *STILL, "optim.gaussians=10")
    start = start_of(folder)
    assert (start == 0.0).all()
    assert (
        f"{len(start)} at the start, though optim.gaussians=10: each vertex has one"
        in capsys.readouterr().out
    )


@pytest.mark.parametrize(("count", "wanted"), [(1, 5), (5, 5), (100, 7)])
def test_frames_that_are_looked_at_are_spread_evenly(count: int, wanted: int) -> None:
    found = spread(count, wanted)
    assert len(found) == len(set(found)) == min(count, wanted)
    assert min(found) >= 0 and max(found) < count
    steps = [b - a for a, b in pairwise(found)]
    assert not steps or max(steps) - min(steps) <= 1


@pytest.mark.parametrize(("extra", "is_closed"), [((), False), (("plan=full",), True)])
def test_clothes_are_measured_only_where_the_surface_is_closed(
    train: Train, monkeypatch: pytest.MonkeyPatch, extra: tuple[str, ...], is_closed: bool
) -> None:
    asked = []

    def measure(*arguments: Any) -> Any:
        asked.append(arguments)
        return measure_clothes(*arguments)

    monkeypatch.setattr(prepare, "measure_clothes", measure)
    folder, _ = train("variant=E", *STILL, "optim.observed_colors=false", "optim.align_poses=false", *extra)
    plan = {d["part"]: d for d in json.loads((folder / "plan.json").read_text())["decisions"]}
    assert plan["surface prior"]["used"] is is_closed and len(asked) == is_closed
