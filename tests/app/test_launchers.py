"""Many jobs at once through Hydra's launchers: the same table, failures and exit code as one after another."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from app.test_multirun import COMMAND, ENVIRONMENT, NO_WEIGHTS
from occfusion.cli import launchers
from occfusion.cli.launchers import is_parallel, missing_launcher


def command(scene_root: Path, *overrides: str) -> list[str]:
    scene = [
        f"dataset.root={scene_root}", "dataset.scene=001-clean", f"body.path={scene_root}/001-clean/body.npz",
        "dataset.test_cameras=[1]", "dataset.test_frames=[0,10,9]",
    ]  # fmt: skip
    return [sys.executable, *COMMAND, *scene, *overrides]


@pytest.mark.parametrize(
    "launcher",
    [
        ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
        ["hydra/launcher=submitit_local"],
        ["hydra/launcher=ray", "+hydra.launcher.ray.init.num_cpus=2"],
    ],
    ids=lambda launcher: launcher[0].split("=")[1],
)
@pytest.mark.slow
def test_jobs_at_once_end_in_one_table(tmp_path: Path, scene_root: Path, launcher: list[str]) -> None:
    """Both seeds want the folder `A`, and both want the complete masks of `B` that one of them makes."""
    if missing_launcher(launcher) is not None:
        pytest.skip(f"{launcher[0]}: not installed")
    done = subprocess.run(
        command(scene_root, "variant=B,E", "seed=0,1", "init.source=truth", *NO_WEIGHTS, *launcher), cwd=tmp_path,
        env=ENVIRONMENT, capture_output=True, text=True, timeout=280, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert sum(line.startswith("failed: ") and "variant=E" in line for line in done.stdout.splitlines()) == 2
    assert "# 4 jobs, 2 finished runs, 2 without a result" in (tmp_path / "sweep" / "table.md").read_text()
    folders = sorted((tmp_path / "runs/zju/001-clean").glob("B*"))
    assert [folder.name for folder in folders] == ["B", "B-2"]
    records = [json.loads((folder / "init" / "stage.json").read_text()) for folder in folders]
    assert sum("shared" in record for record in records) == 1
    assert not list(tmp_path.rglob("*.lock")) and not list(tmp_path.rglob(".at_work"))


@pytest.mark.slow
def test_a_killed_job_stands_in_the_table_and_is_continued(tmp_path: Path, scene_root: Path) -> None:
    launcher = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    endless = command(
        scene_root, "variant=A", "optim.steps=200000", "trainer.max_time=00:00:05:00", "seed=0,1", *launcher
    )
    process = subprocess.Popen(
        endless, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        lock = tmp_path / "runs/zju/001-clean/A/.at_work"
        for _ in range(600):
            if lock.is_file() and (words := lock.read_text().split()):
                break
            time.sleep(0.2)
        os.kill(int(words[1]), signal.SIGKILL)
        out, errors = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 1, errors
    assert "the launcher ended before all jobs had" in out
    text = (tmp_path / "sweep" / "table.md").read_text()
    assert "its process ended without a word" in text and "2 jobs, 0 finished runs" in text


def test_a_launcher_that_is_not_installed_is_named_with_what_installs_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert missing_launcher(["-m", "seed=0,1", "hydra/launcher=basic"]) is None
    monkeypatch.setattr(launchers, "_is_installed", lambda _: False)
    for name, extra in (("joblib", "fleet"), ("submitit_slurm", "fleet"), ("ray", "ray")):
        told = missing_launcher(["-m", f"hydra/launcher={name}"])
        assert told is not None and f'pip install -e ".[{extra}]"' in told


def test_which_launchers_run_jobs_at_once() -> None:
    assert not is_parallel({"_target_": "hydra._internal.core_plugins.basic_launcher.BasicLauncher"})
    assert is_parallel({"_target_": "hydra_plugins.hydra_joblib_launcher.joblib_launcher.JoblibLauncher"})


def test_slurm_jobs_are_composed_as_the_guide_says(tmp_path: Path) -> None:
    """No Slurm here: what would be submitted is composed, with the options that docs/guide/many_runs.md names."""
    options = [
        "timeout_min=240",
        "cpus_per_task=4",
        "gpus_per_node=1",
        "array_parallelism=64",
        "max_num_timeout=3",
    ]
    done = subprocess.run(
        [sys.executable, COMMAND[0], "--cfg", "hydra", "hydra/launcher=submitit_slurm",
         *(f"hydra.launcher.{option}" for option in options)],
        cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for option in options:
        assert option.replace("=", ": ") in done.stdout
