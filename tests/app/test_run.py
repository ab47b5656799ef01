"""Whole runs on a tiny scene: the run folder, resuming, and that two ways to name a scene are the same."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from safetensors.torch import load_file

from app.conftest import UNMEASURED
from occfusion.compare.reading import find_runs
from occfusion.errors import ConfigError
from occfusion.files.images import read_mask
from occfusion.run.loaded import load_run
from occfusion.settings import schema
from occfusion.stages.targets import Target
from occfusion.types import Box, Frame

Train = Callable[..., tuple[Path, dict[str, Any]]]
CONTRACT_FILES = (
    "config.yaml", "environment.json", "plan.json", "optim/last.ckpt", "optim/avatar.safetensors",
    "point_cloud.ply", "losses.csv", "losses.png", "error_vs_time.csv", "error_vs_time.png", "per_image.csv",
    "per_camera.csv", "per_frame.csv", "metrics.json", "report.md",
)  # fmt: skip


def parameters(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(folder / "optim" / "avatar.safetensors")


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


@pytest.mark.parametrize(
    ("variant", "stage"), [(v, s) for v in ("gauhuman", "A", "B", "C", "D", "E") for s in ("all", "optim")]
)
def test_fast_dev_run(train: Train, variant: str, stage: str) -> None:
    folder, metrics = train(f"variant={variant}", f"stage={stage}", "trainer.fast_dev_run=true")
    assert metrics["variant"] == variant
    # 32.8 to 34.3 dB; nobody there or a black person: 22.3, a person 0.4 m from its place: 20.4
    assert metrics["regions"]["full"]["psnr"] > 29
    assert metrics["regions"]["full"]["mask_iou"] > 0.9  # 0.945 to 0.955
    assert not (folder / "optim" / "last.ckpt").exists()


def test_frames_that_no_step_sees_are_left_out_and_the_sequence_has_them(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two of ten; the plan says so, and the record of the motion has all."""
    monkeypatch.setattr(schema, "LEAST_SEEN", 1)
    folder, _ = train("variant=B", "optim.steps=2", "optim.key_light=false")
    plan = json.loads((folder / "plan.json").read_text())
    decided = {d["part"]: d for d in plan["decisions"]}["frames that no step sees"]
    assert not decided["used"] and decided["reason"] == "8 of 10; steps see 2, evenly spread"
    assert plan["scene"]["frames"] == 2 and len(plan["scene"]["visible_share"]) == 2
    assert len(load_run(folder).clip.transl) == 10
    whole, _ = train("variant=B", "optim.steps=2", "optim.key_light=false", "plan=full", folder="full")
    assert json.loads((whole / "plan.json").read_text())["scene"]["frames"] == 10


def test_a_trial_leaves_the_default_folder_to_the_whole_run(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    from occfusion.stages.optim import OptimStage

    steps = []
    original = OptimStage.training_step
    monkeypatch.setattr(OptimStage, "training_step", lambda *a: steps.append(1) or original(*a))
    whole = ("variant=B", "init.source=truth", "registration=off")  # what is tried is no matter
    for _ in range(2):  # the second must try everything again
        folder, _ = train(*whole, "trainer.fast_dev_run=true", chosen=False)
        trial = folder.with_name("run-trial")
        assert not folder.exists() and (trial / "metrics.json").is_file()
    assert len(steps) == 2
    train(*whole, "seed=1", "trainer.fast_dev_run=true", chosen=False)
    train(*whole, "optim.steps=2", chosen=False)
    assert {path.name for path in folder.parent.iterdir() if not path.name.startswith(".")} == {
        "run", "run-trial", "run-trial-2",
    }  # fmt: skip
    assert find_runs([folder.parent]) == [folder]
    assert find_runs([trial]) == [trial]


def test_a_trial_in_a_named_folder_is_tried_again(train: Train) -> None:
    folder, _ = train("trainer.fast_dev_run=true")
    (folder / "note.txt").write_text("mine")
    stamp = (folder / "optim" / "avatar.safetensors").stat().st_mtime_ns
    train("trainer.fast_dev_run=true")
    assert (folder / "optim" / "avatar.safetensors").stat().st_mtime_ns != stamp
    assert (folder / "note.txt").read_text() == "mine"
    with pytest.raises(ConfigError, match="other settings"):
        train("optim.steps=2")


def test_run_folder_holds_what_the_interface_promises(train: Train) -> None:
    # points of the curve lie where the clock says: none falls between the first and the last
    folder, metrics = train("variant=B", "optim.steps=4", "evaluation.curve_first_second=1e4")
    for file in CONTRACT_FILES:
        assert (folder / file).stat().st_size > 0, file
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    assert set(metrics["regions"]) == {"full", "box", "visible", "hidden", "seen_many", "seen_one", "unseen"}
    seen = json.loads((folder / "plan.json").read_text())["coverage"]
    assert seen["seen_many"] + seen["seen_one"] + seen["unseen"] == pytest.approx(1.0, abs=1e-3)
    assert metrics["camera_gain"] == "none" and metrics["camera_gains"] is None
    assert metrics["regions"]["full"]["lpips"] is None
    assert metrics["perceptual_metric"] is None
    assert metrics["images"] == 4
    with (folder / "error_vs_time.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == [0, 4]
    assert list(rows[0]) == [
        "stage", "step", "train_seconds", "wall_seconds", "psnr", "ssim", "lpips", "mask_iou", "gaussians",
        "peak_memory_mb",
    ]  # fmt: skip
    plan = json.loads((folder / "plan.json").read_text())
    assert any(d["part"] == "stage refine" and not d["used"] and d["reason"] for d in plan["decisions"])
    assert "stage refine" in metrics["left_out"]
    manifest = json.loads((folder / "masks" / "manifest.json").read_text())
    assert len(manifest["frames"]) == 10
    assert manifest["identity"]["weights_sha256"]
    assert metrics["train_seconds"]["init"] > 0


@pytest.mark.parametrize("variant", ["gauhuman", "A", "B", "C", "D"])
def test_stopped_and_resumed_run_equals_an_uninterrupted_one(
    train: Train, variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit-equal on a CPU, the LBS network's schedule, the perceptual crops and densification included."""
    from occfusion.stages.interruption import Interrupted, SignalGuard

    options = [
        f"variant={variant}",
        "optim.steps=7",
        "trainer.checkpoint_every=100",
        "registration=off",
        *UNMEASURED,
    ]
    whole, _ = train(*options, folder="whole")
    options.append(f"shared_dir={whole.with_name('apart')}")  # or the whole run's result would be taken over
    original = SignalGuard.on_train_batch_end

    def stop_after_three(self: SignalGuard, trainer: Any, *rest: Any) -> None:
        if trainer.global_step == 3:
            self.received = 15
        original(self, trainer, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(SignalGuard, "on_train_batch_end", stop_after_three)
        with pytest.raises(Interrupted, match="SIGTERM") as stopped:
            train(*options, folder="parts")
    assert stopped.value.exit_code == 143
    parts, _ = train(*options, folder="parts")
    assert_same(parameters(whole), parameters(parts))


def test_finished_run_is_not_trained_again(train: Train) -> None:
    folder, first = train("optim.steps=3")
    stamp = (folder / "optim" / "avatar.safetensors").stat().st_mtime_ns
    _, second = train("optim.steps=3")
    assert (folder / "optim" / "avatar.safetensors").stat().st_mtime_ns == stamp
    assert second["regions"] == first["regions"]
    assert second["train_seconds"] == first["train_seconds"]


def test_folder_of_another_run_is_left_alone(train: Train) -> None:
    folder, _ = train("optim.steps=2")
    before = (folder / "metrics.json").read_bytes()
    with pytest.raises(ConfigError, match="other settings"):
        train("optim.steps=3")
    assert (folder / "metrics.json").read_bytes() == before
    train("optim.steps=3", chosen=False)
    assert (folder.with_name("run-2") / "metrics.json").is_file()


def test_same_seed_same_avatar_other_seed_another(train: Train) -> None:
    a, _ = train("optim.steps=3", folder="a")
    b, _ = train("optim.steps=3", folder="b")
    c, _ = train("optim.steps=3", "seed=1", folder="c")
    assert_same(parameters(a), parameters(b))
    assert not torch.equal(parameters(a)["gaussians.means"], parameters(c)["gaussians.means"])


def test_a_run_from_before_settings_were_removed_is_read(train: Train) -> None:
    folder, _ = train("optim.steps=2")
    expected, config = load_run(folder), OmegaConf.load(folder / "config.yaml")
    earlier = {"trainer.strategy": "auto", "optim.lambda_correction": 0.0, "refine.lambda_correction": 0.0,
               "optim.sds.start_step": 0, "optim.sh_frame": "canonical", "prior.completion.draws": 2,
               "prior.completion.samples": 4, "prior.completion.steps": 6, "prior.completion.seed": 0}  # fmt: skip
    for key, value in earlier.items():
        OmegaConf.update(config, key, value)
    OmegaConf.save(config, folder / "config.yaml")
    found = load_run(folder)
    assert found.settings == expected.settings
    assert_same(found.avatar.gaussians.state_dict(), expected.avatar.gaussians.state_dict())
    OmegaConf.update(config, "optim.no_such_setting", 1)
    OmegaConf.save(config, folder / "config.yaml")
    with pytest.raises(ConfigError, match="no_such_setting"):
        load_run(folder)


def test_non_finite_loss_stops_and_keeps_the_last_good_state(
    train: Train, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from occfusion.__main__ import main
    from occfusion.errors import NumericsError
    from occfusion.quality import losses

    original, calls = losses.l2, []

    def fails_at_the_third(*args: Any, **options: Any) -> torch.Tensor:
        calls.append(1)
        value: torch.Tensor = original(*args, **options)
        return value * float("nan") if len(calls) == 3 else value

    monkeypatch.setattr(losses, "l2", fails_at_the_third)
    with pytest.raises(NumericsError, match=r"step 2, frame .*`mask`"):
        train("optim.steps=5", "optim.lambda_rgb=0", "optim.lambda_ssim=0")
    kept = tmp_path / "run" / "optim" / "bad_step.npz"
    calls[:] = [1, 1]  # the step alone is the third call again
    assert main(["replay", str(kept)]) == 1
    said = capsys.readouterr().out
    assert (
        said.count("step 2, frame Camera_B1/") == 2 and "`mask` is nan" in said and "have changed" not in said
    )
    monkeypatch.setattr(losses, "l2", original)
    assert main(["replay", str(kept)]) == 0
    assert "stage optim, step 2: finite" in capsys.readouterr().out
    folder, _ = train("optim.steps=5", "optim.lambda_rgb=0", "optim.lambda_ssim=0")
    assert all(torch.isfinite(v).all() for v in parameters(folder).values() if v.is_floating_point())


def test_embedded_default_and_the_same_scene_through_the_reader_agree(train: Train, tmp_path: Path) -> None:
    """`dataset=synthetic` and `dataset=zju` on the folder that it wrote give the same avatar, bit for bit."""
    common = ["optim.steps=3", "dataset.image_size=96", "dataset.test_cameras=[1]", "dataset.scene=002-hard"]
    first, _ = train(
        *common, "dataset=synthetic", "body=anny", "body.path=null", f"dataset.root={tmp_path / 'made'}",
        "dataset.frames=6", "dataset.cameras=2", folder="synthetic",
    )  # fmt: skip
    (scene,) = tmp_path.glob("made/*/002-hard")
    second, _ = train(
        *common, f"dataset.root={scene.parent}", f"body.path={scene / 'body.npz'}", folder="zju"
    )
    assert_same(parameters(first), parameters(second))


def test_stage_init_alone_writes_masks_and_is_not_done_again(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, metrics = train("variant=B", "stage=init")
    assert metrics == {}
    first = (folder / "masks" / "manifest.json").read_text()
    record = json.loads((folder / "init" / "stage.json").read_text())
    assert 0 < record["completed"] <= record["frames"] == 10

    def fail(*_: object) -> None:
        raise AssertionError("a prior was loaded although nothing is left to do")

    monkeypatch.setattr("occfusion.priors.embedded.silhouette_prior.EmbeddedMaskPrior.probability", fail)
    train("variant=B", "stage=init")
    assert (folder / "masks" / "manifest.json").read_text() == first


def test_a_scene_without_occlusion_asks_no_prior(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("a prior was made although nothing is hidden")

    monkeypatch.setattr("occfusion.run.init.make_mask_prior", fail)
    folder, _ = train("variant=B", "optim.steps=2", "dataset.occlusion.kind=none")
    plan = json.loads((folder / "plan.json").read_text())
    decision = next(d for d in plan["decisions"] if d["part"] == "complete masks")
    assert not decision["used"]
    assert decision["reason"].startswith("0 of 10")
    assert not (folder / "masks").exists()


def test_complete_masks_are_what_the_optimisation_is_given(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    from occfusion.stages import optim

    seen = []
    crop_frame = optim.crop_frame

    def spy(frame: Frame, box: Box) -> Target:
        seen.append(frame)
        return crop_frame(frame, box)

    monkeypatch.setattr(optim, "crop_frame", spy)
    folder, _ = train("variant=B", "optim.steps=10")
    assert len(seen) == 10
    added = 0
    for frame in seen:
        assert frame.complete_mask is not None
        written = read_mask(folder / "masks" / f"{frame.index:06d}.png")
        assert (frame.complete_mask.numpy() == written).all()
        added += int((frame.complete_mask & ~frame.visible_mask).sum())
    assert added > 0


def test_finished_run_is_taken_over_until_it_is_asked_for_again(train: Train) -> None:
    folder, first = train("variant=A", "optim.steps=2")
    stamp = (folder / "metrics.json").stat().st_mtime_ns
    _, second = train("variant=A", "optim.steps=2")
    assert second == first and (folder / "metrics.json").stat().st_mtime_ns == stamp
    _, third = train("variant=A", "optim.steps=2", "evaluation.training_stride=8")
    assert third["regions"]["visible"] != first["regions"]["visible"]
    stamp = (folder / "metrics.json").stat().st_mtime_ns
    train("variant=A", "optim.steps=2", "evaluation.training_stride=8", "evaluation.again=true")
    assert (folder / "metrics.json").stat().st_mtime_ns != stamp


def test_a_run_reports_the_error_of_depth_where_the_surface_is_known(
    train: Callable[..., tuple[Path, dict[str, Any]]], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, metrics = train("optim.steps=2")
    full = metrics["regions"]["full"]
    assert 2 < full["depth_error_mm"] < 60  # Gaussians on the naked body under clothes
    assert full["depth_images"] == full["images"] == 4
    assert metrics["regions"]["visible"]["depth_error_mm"] > 0
    with (folder / "per_image.csv").open() as file:
        values = [row["depth_error_mm"] for row in csv.DictReader(file) if row["region"] == "full"]
    assert full["depth_error_mm"] == pytest.approx(sum(map(float, values)) / len(values))
    assert "depth error mm" in (folder / "report.md").read_text()
    assert "depth" in capsys.readouterr().out


@pytest.mark.slow
def test_a_stage_that_its_time_ended_says_so(train: Train, capsys: pytest.CaptureFixture[str]) -> None:
    folder, _ = train(
        "stage=optim", "optim.steps=100000", "trainer.max_time=00:00:00:01", "evaluation.curve=false"
    )
    steps = json.loads((folder / "optim" / "stage.json").read_text())["steps"]
    said = capsys.readouterr().out
    assert f"trainer.max_time=00:00:00:01 ended it after {steps} of 100000 steps" in said and steps < 1000
    assert (folder / "metrics.json").is_file()
