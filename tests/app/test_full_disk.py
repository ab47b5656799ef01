"""A disk that fills up while masks or checkpoints are written: a named error, and nothing half is used later."""

from __future__ import annotations

import errno
import os
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch

from app.test_init import CountingPrior, Make, run
from app.test_init import body as body
from app.test_init import data as data
from app.test_init import make as make
from app.test_init import observed_frames as observed_frames
from app.test_lightning_traps import Falling, fitted
from app.test_run import assert_same, parameters
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.errors import CheckpointError, DataError
from occfusion.files.atomic import write_bytes

Train = Callable[..., tuple[Path, dict[str, Any]]]


def full(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("writes", [0, 1, 2, 9])
def test_masks(make: Make, data: ZjuDataModule, monkeypatch: pytest.MonkeyPatch, writes: int) -> None:
    """Uncertainty, mask and manifest of a frame are a write each; the disk is full from the given one on."""
    stage = make(CountingPrior(0.7), smoothing=0.0)
    run(stage, data)
    wanted = {path.name: path.read_bytes() for path in stage.folder.path.glob("*.png")}
    shutil.rmtree(stage.folder.path)
    left, sync = [writes], os.replace

    def replace(source: str, target: Path) -> None:
        left[0] -= 1
        if left[0] < 0:
            full()
        sync(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", replace)
        with pytest.raises(DataError, match=r"masks.*cannot be written .No space left"):
            run(make(CountingPrior(0.7), smoothing=0.0), data)
    assert not [path for path in stage.folder.path.rglob("*") if path.name.endswith(".partial")]
    again = make(CountingPrior(0.7), smoothing=0.0)
    assert len(again.records) == writes // 3  # only what the manifest vouches for
    run(again, data)
    assert {path.name: path.read_bytes() for path in stage.folder.path.glob("*.png")} == wanted


def test_checkpoints(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    options = (
        "optim.steps=5",
        "trainer.checkpoint_every=2",
        "evaluation.held_out=false",
        "evaluation.curve=false",
    )
    whole, _ = train(*options, folder="whole")
    apart = (
        *options,
        f"shared_dir={whole.with_name('apart')}",
    )  # or the whole run's result would be taken over
    save, saved = L.Trainer.save_checkpoint, []

    def save_once(self: L.Trainer, path: Path, *rest: Any, **more: Any) -> None:
        saved.append(self.global_step)
        if len(saved) > 1:
            Path(path).write_bytes(b"half of a checkpoint")
            full()
        save(self, path, *rest, **more)

    with monkeypatch.context() as patch:
        patch.setattr(L.Trainer, "save_checkpoint", save_once)
        with pytest.raises(CheckpointError, match=r"last\.ckpt: cannot be written .No space left"):
            train(*apart, folder="parts")
    assert saved == [2, 4]
    parts = whole.with_name("parts") / "optim"
    assert [path.name for path in parts.iterdir()] == ["last.ckpt"]
    train(*apart, folder="parts")
    assert_same(parameters(whole), parameters(parts.parent))


def test_a_limit_of_file_sizes_is_a_named_error(tmp_path: Path) -> None:
    """Of a shell (`ulimit -f`) or a batch system: what was there stays, and nothing half is left."""
    old, checkpoint = tmp_path / "old.json", tmp_path / "last.ckpt"
    old.write_text("old")
    fitted(tmp_path, [torch.ones(())] * 3, 3)
    whole, before = checkpoint.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(DataError, match=r"old\.json: cannot be written .File too large"):
            write_bytes(old, bytes(5000))
        with pytest.raises(CheckpointError, match=r"last\.ckpt: cannot be written .File too large"):
            fitted(tmp_path, [torch.ones(())] * 4, 4)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert old.read_text() == "old" and checkpoint.read_bytes() == whole
    assert not list(tmp_path.glob("*.partial"))
    assert float(fitted(tmp_path, [torch.ones(())] * 4, 4).number) == pytest.approx(0.6)


def test_a_step_that_takes_long_is_saved_before_a_minute_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[int] = []
    save = L.Trainer.save_checkpoint

    def noted(self: L.Trainer, *rest: Any, **more: Any) -> None:
        saved.append(self.global_step)
        save(self, *rest, **more)

    clock = [0.0]

    class Slow(Falling):
        def training_step(self, batch: torch.Tensor, number: int) -> torch.Tensor:
            clock[0] += 20.0
            return super().training_step(batch, number)

    monkeypatch.setattr(L.Trainer, "save_checkpoint", noted)
    monkeypatch.setattr("occfusion.stages.checkpointing.time.monotonic", lambda: clock[0])
    fitted(tmp_path, [torch.ones(())] * 7, 7, Slow())
    assert saved == [3, 6, 7]
