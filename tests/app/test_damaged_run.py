"""A run folder knows its own: what is damaged in it is made again, and said; nothing damaged is taken over."""

from __future__ import annotations

import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from app.conftest import run_tiny
from app.test_init import CountingPrior, Make, run
from app.test_init import body as body
from app.test_init import data as data
from app.test_init import make as make
from app.test_init import observed_frames as observed_frames
from occfusion.compare.reading import read_run
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.errors import CheckpointError, ConfigError
from occfusion.files.checkpoint import read_checkpoint
from occfusion.files.run_folder import RunFolder
from occfusion.report.page import write_report
from occfusion.run.app import check_checkpoints
from occfusion.run.folder import claim_run_folder, finished_in, identify, record_finished
from occfusion.run.loaded import load_run, read_settings
from occfusion.stages.base import Stage
from occfusion.stages.checkpointing import resumable

OPTIONS = (
    "variant=E", "optim.steps=3", "refine.steps=2", "trainer.checkpoint_every=2", "evaluation.pictures=false",
    "optim.sds.lambda_pose=0", "optim.sds.lambda_can=0", "init.source=truth", "refine.references.source=truth",
)  # fmt: skip


def change(path: Path) -> None:
    """Changes four bytes in the middle, in place: also in every file that is linked to it."""
    with path.open("r+b") as file:
        file.seek(path.stat().st_size // 2)
        four = file.read(4)
        file.seek(-4, 1)
        file.write(bytes(255 - byte for byte in four))


@pytest.fixture(scope="module")
def finished(scene_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_tiny(scene_root, tmp_path_factory.mktemp("finished") / "run", *OPTIONS)[0]


@pytest.fixture
def folder(finished: Path, tmp_path: Path) -> RunFolder:
    """A copy of the finished run, with what it shares with others."""
    shutil.copytree(finished.parent, tmp_path, dirs_exist_ok=True)
    return RunFolder(tmp_path / "run")


@pytest.mark.slow
def test_whatever_is_damaged_is_made_again_and_said(
    scene_root: Path, finished: Path, folder: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = {name: load_file(finished / name / "avatar.safetensors") for name in ("optim", "refine")}
    pictures = {
        path: path.read_bytes()
        for path in [*folder.masks.path.rglob("*.png"), *folder.inpainted.path.rglob("*.png")]
    }
    assert pictures
    change(folder.masks.picture(0))
    change(next(folder.masks.path.parent.parent.glob(".shared/init/*/results/000000.png")))
    folder.masks.picture(3).write_bytes(folder.masks.picture(2).read_bytes())
    (inpainted,) = sorted(folder.inpainted.path.glob("*.png"))[:1]
    inpainted.write_bytes(inpainted.read_bytes()[:100])
    change(folder.stage("optim").avatar)
    change(next(folder.path.parent.glob(".shared/optim/*/results/avatar.safetensors")))
    folder.stage("refine").avatar.unlink()
    change(folder.stage("optim").checkpoint)
    folder.stage("init").record.write_text("garbage")
    folder.curve.write_text("garbage\n1\n")
    run_tiny(scene_root, folder.path, *OPTIONS)
    said = capsys.readouterr().out
    for words in ("what it needs is made again", "init: 2 pictures", "inpaint: 1 pictures", "checksum of",
                  "continues from", "optim: ", "refine: "):  # fmt: skip
        assert words in said, said
    for path, content in pictures.items():
        assert path.read_bytes() == content, path
    for name, tensors in whole.items():
        found = load_file(folder.stage(name).avatar)
        assert all(torch.equal(found[key], value) for key, value in tensors.items()), name


@pytest.mark.slow
def test_a_finished_run_whose_pictures_or_tables_are_damaged_makes_them_again(
    scene_root: Path, folder: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    """They were left as they were, and rows of the refinement were lost where the stage before it was taken over."""
    inpainted = sorted(folder.inpainted.path.rglob("*.png"))[0]
    pictures = {path: path.read_bytes() for path in (folder.masks.picture(0), inpainted)}
    avatars = {name: folder.stage(name).avatar.read_bytes() for name in ("optim", "refine")}
    losses = folder.losses.read_bytes()
    for path in pictures:
        change(path)
    change(folder.stage("optim").avatar)
    assert folder.masks.altered() == [folder.masks.picture(0)] and folder.inpainted.altered() == [inpainted]
    run_tiny(scene_root, folder.path, *OPTIONS)
    said = capsys.readouterr().out
    assert "not as the run left it" in said and "refine: finished before" in said
    assert {path: path.read_bytes() for path in pictures} == pictures
    assert {name: folder.stage(name).avatar.read_bytes() for name in avatars} == avatars
    assert folder.losses.read_bytes() == losses
    shutil.rmtree(folder.masks.path)  # a finished run may be without them
    run_tiny(scene_root, folder.path, *OPTIONS)
    assert "made again" not in capsys.readouterr().out and not folder.masks.path.exists()


def test_the_newest_whole_checkpoint_is_taken(
    short_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = RunFolder(tmp_path).stage("optim")
    shutil.copytree(short_run / "optim", own.path)
    shutil.copyfile(own.checkpoint, own.earlier_checkpoint)
    content = read_checkpoint(own.checkpoint)

    class Known(Stage):
        name = "optim"

        def state_dict(self, *_: Any, **__: Any) -> Any:
            return content["state_dict"]

    assert resumable(own.checkpoint, Known()) == own.checkpoint
    for wrong in ({}, [1], {"state_dict": {}}, {**content, "state_dict": {}}):
        torch.save(wrong, own.checkpoint)
        assert resumable(own.checkpoint, Known()) == own.earlier_checkpoint
        assert "continues from" in capsys.readouterr().out
    own.checkpoint.unlink()  # killed between the two renames
    assert resumable(own.checkpoint, Known()) == own.earlier_checkpoint
    own.checkpoint.write_bytes(b"")
    own.earlier_checkpoint.write_bytes(own.earlier_checkpoint.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match=r"last\.ckpt is damaged.*previous\.ckpt is damaged.*remove"):
        resumable(own.checkpoint, Known())
    own.record.unlink()
    with pytest.raises(CheckpointError, match=r"remove .*optim to start"):
        check_checkpoints(RunFolder(tmp_path))


@pytest.mark.parametrize(
    "content", ["", "garbage", "[]", "{}", '{"identity": 1}', '{"identity": null, "frames": 3}']
)
def test_a_manifest_that_is_none_is_begun_anew(
    make: Make, data: ZjuDataModule, content: str, capsys: pytest.CaptureFixture[str]
) -> None:
    stage = make(CountingPrior(), smoothing=0.0)
    stage.folder.path.mkdir(parents=True)
    stage.folder.manifest.write_text(content)
    assert len(make(CountingPrior(), smoothing=0.0).wanted) == len(stage.observed_frames)
    assert not content or content.startswith('{"identity": ') or "damaged" in capsys.readouterr().out


def test_a_changed_picture_is_seen(
    make: Make, data: ZjuDataModule, capsys: pytest.CaptureFixture[str]
) -> None:
    stage = make(CountingPrior(), smoothing=0.0)
    run(stage, data)
    change(stage.folder.picture(4))
    uncertainty = next((stage.folder.path / stage.folder.second).glob("*.png"))
    change(uncertainty)
    again = make(CountingPrior(), smoothing=0.0)
    assert {again.observed_frames[k].index for k in again.wanted} == {4, int(uncertainty.stem)}
    assert "not as they were left" in capsys.readouterr().out


def test_a_configuration_that_was_cut_short_is_not_taken_for_defaults(
    short_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(short_run, tmp_path / "run")
    folder = RunFolder(tmp_path / "run")
    assert load_run(folder.path).stage == "optim"
    whole = folder.config.read_bytes()
    unset = whole[: whole.index(b"pose_knots:")] + b"pose_knots:"
    for content in (whole[: len(whole) // 2], unset, b"", whole.replace(b"seed: 0", b"seed: 1")):
        folder.config.write_bytes(content)
        with pytest.raises(
            CheckpointError, match=r"config\.yaml is not as the run wrote it; let the same command"
        ):
            load_run(folder.path)
    folder.config.write_bytes(whole)
    change(folder.stage("optim").avatar)
    capsys.readouterr()
    assert load_run(folder.path).step == 12  # of its checkpoint
    assert "not as the stage left it; its last checkpoint is taken" in capsys.readouterr().out


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"images": 3}'])
def test_figures_without_regions_are_measured_again(content: str, short_run: Path, tmp_path: Path) -> None:
    shutil.copytree(short_run, tmp_path / "run")
    folder = RunFolder(tmp_path / "run")
    identity = identify(read_settings(folder))
    folder.metrics.write_text(content)
    record_finished(folder, identity, "data")
    assert finished_in(folder, identity, "data") is None
    with pytest.raises(CheckpointError, match=r"metrics\.json is damaged or missing"):
        read_run(folder.path)


@pytest.mark.parametrize("content", [b"", b"{", b"\x88\xff", b"[" * 100_000, b"[]", b'{"identity": 3}'])
def test_a_marker_of_a_run_that_is_none(content: bytes, short_run: Path, tmp_path: Path) -> None:
    shutil.copytree(short_run, tmp_path / "run")
    folder = RunFolder(tmp_path / "run")
    settings = read_settings(folder)
    folder.environment.write_bytes(content)
    with pytest.raises((CheckpointError, ConfigError), match=r"move the folder away|name another folder"):
        claim_run_folder(replace(settings, output_dir=str(folder.path)), "data", chosen_by_user=True)


@pytest.mark.parametrize("name", ["error_vs_time.csv", "losses.csv"])
@pytest.mark.parametrize("what", ["garbage", "byte", "cut", "another", "missing"])
def test_a_damaged_table_of_the_training_is_said_and_left_out(
    name: str, what: str, short_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was a traceback where it could not be read, and taken over in silence where it was another run's."""
    shutil.copytree(short_run, tmp_path / "run")
    folder, table = RunFolder(tmp_path / "run"), tmp_path / "run" / name
    if not table.is_file():  # the fixture measures no curve
        table.write_text(
            "stage,step,train_seconds,wall_seconds,psnr,ssim,lpips,mask_iou,gaussians,peak_memory_mb\n"
            "optim,0,0,0,10.5,0.9,,0.5,10,1\noptim,12,1,1,20.5,0.9,,0.6,10,1\n"
        )
    settings = read_settings(folder)
    identity = identify(settings)
    write_report(folder)
    record_finished(folder, identity, "data")
    assert f"]({table.with_suffix('.png').name})" in folder.report.read_text()
    assert finished_in(folder, identity, "data") is not None and not folder.altered_tables()
    whole = table.read_text()
    damaged: dict[str, bytes] = {
        "garbage": bytes((17 * k) % 251 for k in range(200)),
        "cut": whole[:-9].encode(),
        "byte": whole.replace(".", ";", 5).encode(),
        "another": whole.replace("optim,12", "optim,11").encode(),
    }
    table.write_bytes(damaged.get(what, b""))
    if what == "missing":
        table.unlink()
    capsys.readouterr()
    report = folder.report.read_bytes()
    write_report(folder)
    said = capsys.readouterr().out
    assert (f"{table} is damaged, and left out of the report" in said) == (what not in ("another", "missing"))
    with pytest.raises(CheckpointError, match="not as the run left it") if "error" in name else nullcontext():
        read_run(folder.path)
    folder.report.write_bytes(report)
    assert finished_in(folder, identity, "data") is not None
    said = capsys.readouterr().out
    assert f"{table} is missing, or not as the run left it; only training could make it again" in said
    assert not table.exists() and (what == "missing") != table.with_name(f"{name}.damaged").is_file()
    write_report(folder)
    assert f"]({table.with_suffix('.png').name})" not in folder.report.read_text()
