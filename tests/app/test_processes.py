"""One scene trained by two processes: other frames, averaged gradients, equal parameters, one set of files."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from app.test_multirun import COMMAND, ENVIRONMENT
from occfusion.cpu.processes import helped_folder
from occfusion.data.sampling import StepSampler
from occfusion.files.lock import only_one

RECORDER = Path(__file__).with_name("two_processes.py")
# a slow machine is to write no row of the curve between the first and the last
SEVEN = (
    "optim.steps=7", "evaluation.curve_first_second=1e4", "trainer.checkpoint_every=100",
    "optim.densify=true", "optim.densification.after_step=1", "optim.densification.every=2",
)  # fmt: skip


def command(scene_root: Path, *overrides: str) -> list[str]:
    scene = [
        f"dataset.root={scene_root}", "dataset.scene=001-clean", f"body.path={scene_root}/001-clean/body.npz",
        "dataset.test_cameras=[1]", "dataset.test_frames=[0,10,9]", "evaluation.pictures=false", "rasterizer=numba",
        "trainer.accelerator=cpu", "trainer.devices=2", "variant=A",
    ]  # fmt: skip
    common = [word for word in COMMAND[1:] if word != "-m" and not word.startswith("hydra.")]
    return [sys.executable, str(RECORDER), *common, *scene, *overrides]


def train(
    cwd: Path, scene_root: Path, *overrides: str, records: str, **environment: str
) -> tuple[Any, list[Any]]:
    done = subprocess.run(
        command(scene_root, *overrides), cwd=cwd, capture_output=True, text=True, timeout=280, check=False,
        env={**ENVIRONMENT, "RECORDS": str(cwd / records), **environment},
    )  # fmt: skip
    files = [cwd / records / f"{rank}.pt" for rank in (0, 1)]
    if not environment:
        assert done.returncode == 0, done.stderr
    return done, [torch.load(file, weights_only=True) for file in files if file.is_file()]


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, scene_root: Path) -> tuple[Path, str, list[Any]]:
    """A run of seven steps that nobody stopped: its folder, what it said, both records; once for all test workers."""
    place = tmp_path_factory.getbasetemp()
    cwd = (place.parent if "PYTEST_XDIST_WORKER" in os.environ else place) / "two_processes"
    said = cwd / "said.txt"
    with only_one(Path(f"{cwd}.lock")):
        if not said.is_file():
            cwd.mkdir()
            said.write_text(train(cwd, scene_root, *SEVEN, records="whole")[0].stdout)
    return (
        cwd,
        said.read_text(),
        [torch.load(cwd / "whole" / f"{rank}.pt", weights_only=True) for rank in (0, 1)],
    )


def assert_averaged(first: dict[str, Any], second: dict[str, Any]) -> None:
    """Both took the mean of their gradients in every step, and have the same Gaussians behind it."""
    assert len(first["local"]) == len(second["local"]) > 0
    for step in range(len(first["local"])):
        mean = (first["local"][step] + second["local"][step]) / 2
        assert torch.allclose(first["averaged"][step], mean, rtol=1e-5, atol=1e-9)
        assert torch.equal(first["averaged"][step], second["averaged"][step])
        assert not torch.allclose(first["local"][step], second["local"][step], rtol=1e-2)
    assert first["gaussians"] == second["gaussians"] and first["gaussians"][-1] > first["gaussians"][0]
    assert_same(first["state"], second["state"])


@pytest.mark.slow
def test_two_processes_train_one_avatar(whole: tuple[Path, str, list[Any]]) -> None:
    """Other frames, equal parameters; Gaussians that are added between steps are averaged as those before them."""
    cwd, said, (first, second) = whole
    sampler = StepSampler(10, 0)
    dealt = [f"Camera_B1/{sampler.position_at(k):06d}" for k in range(14)]
    assert (first["frames"][:7], second["frames"][:7]) == (dealt[0::2], dealt[1::2])
    assert len(first["local"]) == 7
    assert_averaged(first, second)
    folder = cwd / "runs/zju/001-clean/A"
    written = load_file(folder / "optim" / "avatar.safetensors")
    assert torch.equal(written["gaussians.means"], first["state"]["gaussians.means"])
    assert [path.name for path in folder.parent.iterdir() if not path.name.startswith(".")] == ["A"]
    assert said.count("run folder: ") == 1 and not list(folder.rglob("*.partial"))
    assert (folder / "error_vs_time.csv").read_text().count("\noptim,") == 2
    assert (folder / "losses.csv").read_text().count("\noptim,") == 7


@pytest.mark.slow
def test_stopped_by_a_signal_to_one_of_them_and_resumed(
    whole: tuple[Path, str, list[Any]], tmp_path: Path, scene_root: Path
) -> None:
    """Both stop after the same step, a round of densification behind them and one before, and the same command gives
    what an uninterrupted one does, bit for bit."""
    expected = whole[2][0]
    stopped, before = train(tmp_path, scene_root, *SEVEN, records="stopped", STOP_AT="4")
    assert stopped.returncode == 143, stopped.stderr
    assert "the same command continues" in stopped.stderr
    assert [len(record["local"]) for record in before] == [4, 4]
    assert_averaged(*before)
    resumed, after = train(tmp_path, scene_root, *SEVEN, records="resumed")
    assert resumed.returncode == 0, resumed.stderr
    assert len(after[0]["local"]) == 3
    assert_averaged(*after)
    assert_same(after[0]["state"], expected["state"])


@pytest.mark.slow
def test_a_trial_and_complete_masks_in_two_processes(tmp_path: Path, scene_root: Path) -> None:
    done, records = train(
        tmp_path, scene_root, "variant=B", "init.source=truth", "trainer.fast_dev_run=true", records="trial"
    )
    assert done.returncode == 0, done.stderr
    assert len(records) == 2
    assert (tmp_path / "runs/zju/001-clean/B-trial/metrics.json").is_file()


def test_a_multirun_refuses_several_processes_a_scene(tmp_path: Path, scene_root: Path) -> None:
    done = subprocess.run(
        [sys.executable, *COMMAND, "variant=A", "seed=0,1", "trainer.devices=2"], cwd=tmp_path, env=ENVIRONMENT,
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stdout.count("which a multirun is not for") == 2


def test_a_process_that_another_launcher_has_numbered_is_told_so(tmp_path: Path, scene_root: Path) -> None:
    done, _ = train(tmp_path, scene_root, "optim.steps=2", records="none", LOCAL_RANK="1")
    assert done.returncode == 1
    assert "`python train.py` starts the others itself" in done.stderr
    assert not (tmp_path / "runs").exists()


def test_who_helps_nobody_has_no_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    assert helped_folder() is None
    monkeypatch.setenv("LOCAL_RANK", "0")
    monkeypatch.setenv("OCCFUSION_RUN_FOLDER", os.sep)
    assert helped_folder() is None
    monkeypatch.setenv("LOCAL_RANK", "2")
    assert helped_folder() == Path(os.sep)
