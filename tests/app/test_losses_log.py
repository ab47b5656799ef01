"""`losses.csv`: every step once, whatever happened in between, and no waiting for an accelerator."""

import csv
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from occfusion.errors import CheckpointError, DataError
from occfusion.files.run_folder import RunFolder
from occfusion.stages.base import Stage
from occfusion.stages.interruption import Interrupted, SignalGuard
from occfusion.stages.losses_log import BATCH_ROWS, LossLog, LossTable

Train = Callable[..., tuple[Path, dict[str, Any]]]


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_step_has_its_terms_their_weighted_sum_rates_and_gaussians(train: Train) -> None:
    weights = {"rgb": 1e4, "mask": 2e4, "ssim": 1e3, "sds_pose": 2 * 10.0, "sds_can": 2 * 20.0}
    weights |= {f"surface_{name}": 4 * 1e4 for name in ("outline", "backface")}  # every fourth step
    folder, metrics = train(
        "variant=D", "optim.steps=6", "plan=full", "optim.lambda_rgb=1e4", "optim.lambda_mask=2e4",
        "optim.lambda_ssim=1e3", "optim.sds.lambda_pose=10", "optim.sds.lambda_can=20", "optim.sds.every=2",
        "optim.sds.where=everywhere",
    )  # fmt: skip
    rows = rows_of(RunFolder(folder).losses)
    assert [(row["stage"], row["step"]) for row in rows] == [("optim", str(k)) for k in range(1, 7)]
    distilled = []
    for row in rows:
        asked = {name: float(row[name]) for name in weights if row.get(name)}
        assert float(row["total"]) == pytest.approx(sum(weights[k] * v for k, v in asked.items()), rel=1e-4)
        assert {"rgb", "mask", "ssim"} <= set(asked) and "lpips" not in row
        distilled.append(sum(name.startswith("sds_") for name in asked))
        assert int(row["gaussians"]) == metrics["gaussians"]
        assert float(row["rate_sh0"]) == pytest.approx(2.5e-3)
    assert distilled == [1, 0, 1, 0, 1, 0]
    assert float(rows[0]["rate_means"]) > float(rows[-1]["rate_means"]) > 0


@pytest.mark.slow
def test_stopped_and_killed_runs_end_with_the_table_of_an_uninterrupted_one(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ["optim.steps=8", "trainer.checkpoint_every=3"]
    whole, _ = train(*options, folder="whole")
    expected = (RunFolder(whole).losses).read_bytes()
    assert expected.count(b"\noptim,") == 8
    options.append(f"shared_dir={whole.with_name('apart')}")  # or the whole run's result would be taken over
    original = SignalGuard.on_train_batch_end

    def end_at(last: int, fault: bool) -> Callable[..., None]:
        def hook(self: SignalGuard, trainer: Any, *rest: Any) -> None:
            if trainer.global_step == last and fault:
                raise RuntimeError("killed")
            if trainer.global_step == last:
                self.received = 15
            original(self, trainer, *rest)

        return hook

    for last, fault, error in ((2, False, Interrupted), (6, True, RuntimeError)):
        with monkeypatch.context() as patch:
            patch.setattr(SignalGuard, "on_train_batch_end", end_at(last, fault))
            with pytest.raises(error):
                train(*options, folder="parts")
    table = RunFolder(whole.with_name("parts")).losses
    kept = len(rows_of(table))
    assert kept == 5  # the checkpoint is that of step 3
    with table.open("a") as file:
        file.write("optim,6,123.4")  # what a kill in the middle of writing leaves
    train(*options, folder="parts")
    assert table.read_bytes() == expected


@pytest.mark.slow
def test_a_run_that_takes_a_stage_over_has_its_losses(
    train: Train, capsys: pytest.CaptureFixture[str]
) -> None:
    first, _ = train("variant=A", "optim.steps=2", folder="first")
    second, _ = train("variant=A", "optim.steps=2", "evaluation.training_stride=4", folder="second")
    assert "optim: trained before, taken from" in capsys.readouterr().out
    assert (RunFolder(second).losses).read_bytes() == (RunFolder(first).losses).read_bytes()
    assert len(rows_of(RunFolder(second).losses)) == 2


def test_a_table_grows_by_rows_and_by_columns(tmp_path: Path) -> None:
    table = LossTable(RunFolder(tmp_path).losses)
    table.append(
        [{"stage": "optim", "step": 1, "total": 2.0, "rgb": 0.1234567, "rate_means": 0.5, "gaussians": 7}]
    )
    table.append([{"stage": "optim", "step": 2, "total": 3.0, "gaussians": 8}])
    before = (RunFolder(tmp_path).losses).read_text()
    assert before.splitlines()[1:] == ["optim,1,2,0.123457,0.5,7", "optim,2,3,,,8"]
    table.append([{"stage": "refine", "step": 1, "total": 4.0, "gen": 0.25, "gaussians": 9}])
    assert (RunFolder(tmp_path).losses).read_text().splitlines() == [
        "stage,step,total,rgb,gen,rate_means,gaussians",
        "optim,1,2,0.123457,,0.5,7", "optim,2,3,,,,8", "refine,1,4,,0.25,,9",
    ]  # fmt: skip
    again = LossTable(RunFolder(tmp_path).losses)
    again.open(lambda row: row["stage"] != "optim" or int(row["step"]) <= 1)
    again.append([{"stage": "optim", "step": 2, "total": 5.0}])
    assert [(r["stage"], r["step"], r["total"]) for r in rows_of(RunFolder(tmp_path).losses)] == [
        ("optim", "1", "2"), ("refine", "1", "4"), ("optim", "2", "5"),
    ]  # fmt: skip


@pytest.mark.parametrize("content", ["stage,step,total\noptim,one,2\n", "a,b\n1,2\n"])
def test_what_is_no_loss_table_is_refused(tmp_path: Path, content: str) -> None:
    (RunFolder(tmp_path).losses).write_text(content)
    with pytest.raises(CheckpointError, match=r"losses\.csv, line 2.*move the file away"):
        LossTable(RunFolder(tmp_path).losses).open(lambda row: int(row["step"]) < 9)


def test_a_full_disk_is_a_named_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = LossTable(RunFolder(tmp_path).losses)
    row = {"stage": "optim", "step": 1}
    table.append([row])

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(DataError, match=r"losses\.csv: cannot be written \(No space left"):
        table.append([row])


class _Reads(TorchDispatchMode):
    """Counts the reads that would wait for an accelerator."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += func in (torch.ops.aten._local_scalar_dense.default, torch.ops.aten._to_copy.default)
        return func(*args, **(kwargs or {}))


def test_values_are_read_in_batches(tmp_path: Path) -> None:
    stage = Stage()
    stage.name = "optim"
    group = {"name": "means", "lr": 0.1}
    trainer: Any = SimpleNamespace(
        global_step=0, optimizers=[SimpleNamespace(param_groups=[group])], loggers=[]
    )
    log = LossLog(RunFolder(tmp_path).losses)
    log.on_train_start(trainer, stage)
    with _Reads() as reads:
        for step in range(1, BATCH_ROWS):
            trainer.global_step = step
            terms = {"rgb": torch.tensor(float(step)), "mask": torch.tensor(0.5)}
            stage.keep_terms(terms, terms["rgb"] + 3 * terms["mask"])
            log.on_train_batch_end(trainer, stage)
    assert reads.count == 0 and not (RunFolder(tmp_path).losses).exists()
    trainer.global_step = BATCH_ROWS
    log.on_train_batch_end(trainer, stage)
    rows = rows_of(RunFolder(tmp_path).losses)
    assert [row["rgb"] for row in rows] == [*map(str, range(1, BATCH_ROWS)), str(BATCH_ROWS - 1)]
    assert rows[8] == {
        "stage": "optim",
        "step": "9",
        "total": "10.5",
        "rgb": "9",
        "mask": "0.5",
        "rate_means": "0.1",
    }
    log.on_save_checkpoint(trainer, stage, {})
    assert len(rows_of(RunFolder(tmp_path).losses)) == BATCH_ROWS  # nothing twice
