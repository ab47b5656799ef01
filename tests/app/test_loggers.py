"""Loggers besides `losses.csv`: what they get, that training stays the same, what is said where one is missing."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from app.test_losses_log import rows_of
from app.test_run import assert_same, parameters
from occfusion.errors import ConfigError
from occfusion.files.run_folder import RunFolder
from occfusion.settings.stages import LoggerSettings
from occfusion.stages import loggers
from occfusion.stages.interruption import SignalGuard
from occfusion.stages.loggers import beside_truth, check_logger

Train = Callable[..., tuple[Path, dict[str, Any]]]


@pytest.mark.slow
def test_tensorboard_has_curves_and_pictures_and_training_stays_the_same(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that was killed after step 5 and went on from step 3 shows each step once."""
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    options = ("optim.steps=6", "trainer.checkpoint_every=3")
    plain, _ = train(*options, folder="plain")
    options = (*options, "logger=tensorboard", "logger.every=1", "logger.pictures_every=2")
    options = (
        *options,
        f"shared_dir={plain.with_name('apart')}",
    )  # or the plain run's result would be taken over
    original = SignalGuard.on_train_batch_end

    def kill(self: SignalGuard, trainer: Any, *rest: Any) -> None:
        if trainer.global_step == 6:
            raise RuntimeError("killed")
        original(self, trainer, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(SignalGuard, "on_train_batch_end", kill)
        with pytest.raises(RuntimeError, match="killed"):
            train(*options, folder="run")
    folder, _ = train(*options, folder="run")
    assert_same(parameters(plain), parameters(folder))
    events = accumulator.EventAccumulator(str(folder / "tensorboard" / "optim")).Reload()
    rows = rows_of(RunFolder(folder).losses)
    assert (RunFolder(folder).losses).read_bytes() == (RunFolder(plain).losses).read_bytes()
    for tag, column in (
        ("loss/total", "total"),
        ("loss/rgb", "rgb"),
        ("rate/means", "rate_means"),
        ("gaussians", "gaussians"),
    ):
        points = [(event.step, event.value) for event in events.Scalars(tag)]
        assert points == [
            (k, pytest.approx(float(row[column]), rel=1e-5)) for k, row in enumerate(rows, 1)
        ], tag
    assert [event.step for event in events.Scalars("held_out/psnr")][-1] == 6
    for name in ("training", "held_out"):
        pictures = events.Images(f"pictures/{name}")
        assert [picture.step for picture in pictures] == [2, 4, 6]
        assert (pictures[0].width, pictures[0].height) == (192, 96)


@pytest.mark.slow
def test_wandb_without_a_network_writes_a_run_a_stage(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_ERROR_REPORTING", "false")
    monkeypatch.setenv("WANDB_SILENT", "true")
    folder, _ = train(
        "variant=A", "optim.steps=3", "logger=wandb", "logger.offline=true", "logger.every=1", "logger.pictures_every=2"
    )  # fmt: skip
    identity = (folder / "wandb" / "optim.id").read_text()
    (log,) = folder.glob(f"wandb/offline-run-*-{identity}/run-{identity}.wandb")
    content = log.read_bytes()
    for word in (b"loss/total", b"rate/means", b"held_out/psnr", b"pictures/training", b"lambda_rgb"):
        assert word in content, word
    assert len(list(log.parent.glob("files/media/images/pictures/*.png"))) == 2
    assert wandb.run is None, "the next stage would be logged into this one's run"


def test_wandb_that_cannot_begin_says_what_to_do(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wandb = pytest.importorskip("wandb")

    def refuse(**_: Any) -> None:
        raise wandb.errors.UsageError("No API key configured.")

    monkeypatch.setattr(wandb, "init", refuse)
    with pytest.raises(ConfigError, match=r"No API key configured.*logger\.offline=true"):
        train("variant=A", "optim.steps=1", "logger=wandb")


@pytest.mark.parametrize("name", ["tensorboard", "wandb"])
def test_a_missing_package_is_said_before_anything_is_done(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    real = loggers.importlib.util.find_spec  # type: ignore[attr-defined]
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda package, *rest: None if package == name else real(package, *rest)
    )
    with pytest.raises(ConfigError, match=rf"logger={name} needs the extra.*pip install -e '\.\[{name}\]'"):
        train(f"logger={name}")
    assert not (tmp_path / "run").exists()
    check_logger(LoggerSettings())


def test_what_is_not_chosen_is_not_imported() -> None:
    code = (
        "import json, sys, occfusion.stages.loggers as l; from pathlib import Path; "
        "l.make_logs(l.Settings(), l.RunFolder(Path('.')), 'optim', None); "
        "print(json.dumps([m for m in ('tensorboard', 'torch.utils.tensorboard', 'wandb') if m in sys.modules]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=100, check=True
    )
    assert json.loads(done.stdout) == []


def test_a_trial_leaves_the_table_alone(train: Train) -> None:
    folder, _ = train("logger=tensorboard", "trainer.fast_dev_run=true")
    assert [row["step"] for row in rows_of(RunFolder(folder).losses)] == ["1"]
    assert not (folder / "tensorboard").exists()


def test_a_rendering_stands_beside_the_truth_or_what_was_seen() -> None:
    class Shown:
        rgb = torch.zeros(2, 3, 3)
        truth: Any = None

    frame: Any = Shown()
    picture = beside_truth(torch.full((2, 3, 3), 2.0), frame)
    assert picture.shape == (2, 6, 3) and picture.dtype == np.uint8
    assert (picture[:, :3] == 255).all() and (picture[:, 3:] == 0).all()
    frame.truth = Shown()
    frame.truth.rgb = torch.full((2, 3, 3), 0.5)
    assert (beside_truth(torch.zeros(2, 3, 3), frame)[:, 3:] == 128).all()
