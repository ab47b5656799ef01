"""Stages that variants share are computed once."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from occfusion.files.run_folder import RunFolder
from occfusion.files.sharing import offer, shared_folder, take
from occfusion.run import training
from occfusion.stages import framewise

Train = Callable[..., tuple[Path, dict[str, Any]]]
MASKS_ALONE = ("stage=init", "init.source=truth")


@pytest.fixture
def predictions(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of frames that were really completed, one entry a run that completed any."""
    made: list[int] = []
    original = framewise.predict_frames

    def count(stage: Any, read: Any, wanted: Any, **options: Any) -> int | None:
        made.append(len(wanted))
        return original(stage, read, wanted, **options)

    monkeypatch.setattr(framewise, "predict_frames", count)
    return made


def masks(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted((folder / "masks").rglob("*.png"))}


def test_masks_are_completed_once(train: Train, predictions: list[int]) -> None:
    first, _ = train("variant=B", *MASKS_ALONE, folder="first")
    second, _ = train("variant=B", "optim.steps=7", "seed=3", *MASKS_ALONE, folder="second")
    assert predictions == [10]
    assert masks(first) == masks(second) and len(masks(first)) >= 10
    manifests = [json.loads((f / "masks/manifest.json").read_text()) for f in (first, second)]
    assert manifests[0] == manifests[1]
    records = [json.loads((f / "init/stage.json").read_text()) for f in (first, second)]
    assert records[1].pop("shared") and records[0] == records[1]
    train("variant=B", *MASKS_ALONE, "init.threshold=0.4", folder="third")
    assert predictions == [10, 10]


def test_what_one_run_does_to_its_masks_is_its_own(train: Train, predictions: list[int]) -> None:
    first, _ = train("variant=B", *MASKS_ALONE, folder="first")
    before = masks(first)
    second, _ = train("variant=B", *MASKS_ALONE, folder="second")
    (second / "masks" / "000001.png").unlink()
    train("variant=B", *MASKS_ALONE, folder="second")
    assert masks(first) == before == masks(second)
    assert predictions == [10]


def test_damaged_shared_masks_are_made_again(train: Train, predictions: list[int]) -> None:
    first, _ = train("variant=B", *MASKS_ALONE, folder="first")
    (shared,) = (first.parent / ".shared" / "init").iterdir()
    (shared / "results" / "000002.png").unlink()
    second, _ = train("variant=B", *MASKS_ALONE, folder="second")
    assert predictions == [10, 10] and masks(first) == masks(second)
    assert (shared / "results" / "000002.png").is_file()
    (shared / "stage.json").unlink()
    train("variant=B", *MASKS_ALONE, folder="third")
    train("variant=B", *MASKS_ALONE, folder="fourth")
    assert predictions == [10, 10, 10]


def test_the_shared_folder_can_be_chosen(tmp_path: Path) -> None:
    a = shared_folder(RunFolder(tmp_path / "run"), None, "init", {"data": "x", "k": 1})
    assert a.parent == tmp_path / ".shared" / "init"
    assert (
        a.name
        == shared_folder(RunFolder(tmp_path / "run"), str(tmp_path), "init", {"k": 1, "data": "x"}).name
    )
    assert a.name != shared_folder(RunFolder(tmp_path / "run"), None, "init", {"data": "y", "k": 1}).name


def test_another_version_of_the_program_does_not_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it would have made is not known: poses may be aligned in another way, and masks be completed about them."""
    asked = RunFolder(tmp_path / "run"), None, "init", {"data": "x"}
    before = shared_folder(*asked)
    monkeypatch.setattr("occfusion.__version__", "0.0.1")
    assert shared_folder(*asked) != before


def test_without_links_files_are_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise OSError

    monkeypatch.setattr(os, "link", refuse)
    (tmp_path / "masks" / "deep").mkdir(parents=True)
    (tmp_path / "masks" / "deep" / "a.png").write_bytes(b"1")
    (tmp_path / "stage.json").write_text('{"train_seconds": 1}')
    offer(tmp_path / "shared" / "k", tmp_path / "masks", tmp_path / "stage.json")
    offer(tmp_path / "shared" / "k", tmp_path / "masks", tmp_path / "stage.json")
    assert [path.name for path in (tmp_path / "shared").iterdir()] == ["k"]
    assert take(tmp_path / "shared" / "k", tmp_path / "other") == {"train_seconds": 1}
    assert (tmp_path / "other" / "deep" / "a.png").read_bytes() == b"1"
    assert take(tmp_path / "shared" / "none", tmp_path / "other") is None


def test_the_optimisation_of_d_serves_e(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    common = (
        "optim.steps=3",
        "refine.steps=2",
        "refine.references.source=coarse",
        "init.source=truth",
        "sds=code",
    )
    common = (
        *common,
        "optim.sds.lambda_pose=0",
        "optim.sds.lambda_can=0",
        "refine.hidden.target=complete",
        "refine.densify=false",
        "optim.key_light=false",
        "optim.dilation=0.3",
        "optim.thickness=0",
        "optim.observed_colors=false",
        "optim.rates.scales=0.05",
    )  # weights, light and Gaussians at the start alike, whatever they are
    d, first = train("variant=D", *common, folder="d")
    trained: list[str] = []
    original = training.fit

    def count(stage: Any, *rest: Any, **options: Any) -> int:
        trained.append(stage.name)
        return original(stage, *rest, **options)

    monkeypatch.setattr(training, "fit", count)
    e, second = train("variant=E", *common, folder="e")
    assert trained == ["refine"]
    assert (e / "optim" / "avatar.safetensors").read_bytes() == (
        d / "optim" / "avatar.safetensors"
    ).read_bytes()
    assert second["train_seconds"]["optim"] == first["train_seconds"]["optim"] > 0
    stages = [row.split(",")[0] for row in (e / "error_vs_time.csv").read_text().splitlines()[1:]]
    assert stages[0] == "optim" and stages[-1] == "refine"
    train("variant=E", *common, "optim.rates.sh0=0.01", folder="other")
    assert trained == ["refine", "optim", "refine"]
