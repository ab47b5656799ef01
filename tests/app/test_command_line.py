"""The command lines as a user types them, in processes of their own."""

import gc
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from occfusion.cpu.loading import loading

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
LIGHT = ["optim.lambda_lpips=0", "evaluation.perceptual=false", "evaluation.curve=false"]


def run(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )


def test_train_with_all_defaults_on_a_tiny_scene(tmp_path: Path) -> None:
    done = run(str(ROOT / "train.py"), "trainer.fast_dev_run=true", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "run folder: runs/synthetic/001-clean/E" in done.stdout
    assert "ST-LPIPS (VGG)" in done.stdout


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("optim.stepz=3", "stepz"),
        ("dataset=nowhere", "nowhere"),
        ("variant=F", "variant"),
        ("dataset=zju body=anny", "dataset.root"),
        ("dataset=zju", "body.path"),
    ],
)
def test_a_mistake_is_one_plain_message_and_leaves_nothing(
    tmp_path: Path, override: str, message: str
) -> None:
    done = run(str(ROOT / "train.py"), *override.split(), cwd=tmp_path)
    assert done.returncode != 0
    assert message in done.stderr + done.stdout
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.rglob("metrics.json"))
    assert not list(tmp_path.rglob("environment.json"))


def test_synth_then_zju_then_render(tmp_path: Path) -> None:
    done = run(
        "-m", "occfusion", "synth", "scenes", "--size", "96", "--frames", "4", "--cameras", "3", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    scene = tmp_path / "scenes" / "001-clean"
    assert (scene / "annots.npy").is_file()
    done = run(
        str(ROOT / "train.py"), "stage=optim", "dataset=zju", "dataset.root=scenes", "dataset.scene=001-clean",
        "body.path=scenes/001-clean/body.npz", "variant=A", "optim.steps=3", *LIGHT, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "runs" / "zju" / "001-clean" / "A"
    assert (folder / "metrics.json").is_file()
    options = ["--frames", "2", "--size", "64", "--output", "o.mp4"]
    done = run("-m", "occfusion", "render", str(folder), *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "o.mp4").stat().st_size > 500


@pytest.mark.skipif(not hasattr(signal, "SIGTERM") or os.name == "nt", reason="POSIX signals")
def test_sigterm_saves_exits_with_143_and_the_same_command_goes_on(tmp_path: Path) -> None:
    run("-m", "occfusion", "synth", "scenes", "--size", "96", "--frames", "4", "--cameras", "2", cwd=tmp_path)
    command = [
        sys.executable, str(ROOT / "train.py"), "dataset=zju", "dataset.root=scenes", "dataset.scene=001-clean",
        "body.path=scenes/001-clean/body.npz", *LIGHT, "output_dir=out", "optim.steps=100000",
    ]  # fmt: skip
    with subprocess.Popen(
        command, cwd=tmp_path, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True
    ) as process:
        deadline = time.monotonic() + 200
        while not (tmp_path / "out/optim/last.ckpt").exists() and time.monotonic() < deadline:
            time.sleep(0.2)
        process.terminate()
        _, errors = process.communicate(timeout=100)
    assert process.returncode == 143, errors
    assert "the same command continues" in errors


def test_garbage_is_searched_for_again_after_loading() -> None:
    with loading():
        with loading():
            pass
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ImportError), loading():
        import occfusion.nothing_of_this_name  # noqa: F401
    assert gc.isenabled()


@pytest.mark.parametrize(("given", "threads"), [(None, "1"), ("2", "2")])
def test_opencv_gets_one_thread_where_the_user_says_nothing(
    given: str | None, threads: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(ENVIRONMENT, "OPENCV_FOR_THREADS_NUM", raising=False)
    if given is not None:
        monkeypatch.setitem(ENVIRONMENT, "OPENCV_FOR_THREADS_NUM", given)
    program = """
from occfusion.cpu.loading import loading
with loading():
    import cv2
print(cv2.getNumThreads())
"""
    done = run("-c", program, cwd=tmp_path)
    assert done.stdout.split() == [threads], done.stderr
