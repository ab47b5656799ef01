"""`python train.py -m`: the table at the end, what failed, and that finished jobs are not run again."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from occfusion.cli.multirun import JobRecord, record_job, write_end_table
from run_folders import write_run

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
COMMAND = [
    str(ROOT / "train.py"), "-m", "optim.steps=2", "dataset=zju", "body=anny",
    "optim.lambda_lpips=0", "evaluation.perceptual=false", "evaluation.curve_images=1",
    "trainer.enable_progress_bar=false", "optim.align_poses=false", "optim.unseen_colors=nearest",
    "hydra.sweep.dir=sweep",
]  # fmt: skip
NO_WEIGHTS = ("refine.references.source=prior", "prior.inpaint.weights=nowhere.safetensors")
"""Makes the jobs of variant E fail, and no others."""


def train(cwd: Path, *overrides: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *COMMAND, *overrides], cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True,
        timeout=250, check=False,
    )  # fmt: skip


@pytest.mark.slow
def test_table_failures_and_no_second_run(tmp_path: Path, scene_root: Path) -> None:
    scene = [
        f"dataset.root={scene_root}", "dataset.scene=001-clean", f"body.path={scene_root}/001-clean/body.npz"
    ]  # fmt: skip
    done = train(tmp_path, "variant=A,E", "seed=0,1", *NO_WEIGHTS, *scene)
    assert done.returncode == 1, done.stderr
    assert sum(line.startswith("failed: ") and "variant=E" in line for line in done.stdout.splitlines()) == 2
    text = (tmp_path / "sweep" / "table.md").read_text()
    assert "# 4 jobs, 2 finished runs, 2 without a result" in text
    assert "nowhere.safetensors: no such file" in text
    assert "% failed: " in (tmp_path / "sweep" / "table.tex").read_text()
    assert (tmp_path / "sweep" / "table.csv").read_text().count("\nseeds,zju,001-clean,A,2,") == 1
    files = sorted(tmp_path.glob("runs/zju/001-clean/A*/metrics.json"))
    assert [file.parent.name for file in files] == ["A", "A-2"]
    stamps = [file.stat().st_mtime_ns for file in files]
    again = train(tmp_path, "variant=A", "seed=0,1", *scene)
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("finished before, taken from") == 2
    assert [file.stat().st_mtime_ns for file in files] == stamps
    assert "without a result" not in again.stdout
    assert len(list((tmp_path / "sweep" / "jobs").iterdir())) == 2  # none of the earlier sweep
    os.utime(scene_root / "001-clean" / "body.npz")  # the data may have changed: they are looked at again
    third = train(tmp_path, "variant=A", "seed=0", *scene)
    assert third.returncode == 0, third.stderr
    assert "finished before" not in third.stdout
    assert [file.stat().st_mtime_ns for file in files] == stamps


def test_all_jobs_stand_in_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record_job(tmp_path, JobRecord(0, "variant=A", folder=str(write_run(tmp_path / "a"))))
    bad = write_run(tmp_path / "b", variant="B")
    (bad / "metrics.json").write_text("{")
    record_job(tmp_path, JobRecord(1, "variant=B", folder=str(bad)))
    assert write_end_table(tmp_path) == 1
    record_job(tmp_path, JobRecord(2, "variant=C", error="stopped | by a signal", exit_code=143))
    record_job(tmp_path, JobRecord(10, "stage=init"))
    assert write_end_table(tmp_path) == 143
    text = (tmp_path / "table.md").read_text()
    assert "# 4 jobs, 1 finished runs, 2 without a result" in text
    assert "failed: variant=C: stopped | by a signal" in capsys.readouterr().out


def test_no_job_has_finished(tmp_path: Path) -> None:
    record_job(tmp_path, JobRecord(0, "variant=C", error="no", exit_code=1))
    assert write_end_table(tmp_path) == 1
    assert json.loads((tmp_path / "jobs" / "0.json").read_text())["error"] == "no"
    assert "**variant=C**: no" in (tmp_path / "table.md").read_text()
