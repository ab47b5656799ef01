"""The refinement stage in whole runs: references, hand-over, resuming, and what an unoccluded scene is spared."""

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from app.conftest import UNMEASURED
from occfusion.data.sampling import StepSampler
from occfusion.errors import DataError
from occfusion.files.images import read_mask, read_rgb
from occfusion.files.run_folder import RunFolder
from occfusion.human import Avatar
from occfusion.inpaint.accumulation import Accumulated
from occfusion.inpaint.partial import Inpainter, Partial, Picture
from occfusion.run.loaded import load_run
from occfusion.run.refine import repaint_unseen
from occfusion.run.training import AvatarTraining
from occfusion.splat.harmonics import SH_C0
from occfusion.stages.avatar import AvatarStage
from occfusion.stages.interruption import Interrupted, SignalGuard
from occfusion.stages.references import References
from occfusion.types import Frame

Train = Callable[..., tuple[Path, dict[str, Any]]]
SHORT = (
    "variant=E", "optim.sds.lambda_pose=0", "optim.sds.lambda_can=0", "optim.steps=4", "refine.steps=5",
    "refine.lambda_lpips=0", "refine.references.source=coarse",
)  # fmt: skip


class Green(Inpainter):
    """Paints everything green, and counts how often it was asked."""

    name = "green"

    def __init__(self) -> None:
        self.asked = 0

    def describe(self) -> dict[str, Any]:
        return {"inpainter": self.name}

    def inpaint(self, partial: Partial) -> Picture:
        self.asked += 1
        return np.zeros_like(partial.coarse) + np.float32([0.0, 1.0, 0.0])


@pytest.fixture
def green(monkeypatch: pytest.MonkeyPatch) -> Green:
    made = Green()
    monkeypatch.setattr("occfusion.run.refine.make_inpainter", lambda *_: made)
    return made


def parameters(folder: Path, stage: str = "refine") -> dict[str, torch.Tensor]:
    return load_file(folder / stage / "avatar.safetensors")


def decisions(folder: Path) -> dict[str, dict[str, Any]]:
    return {d["part"]: d for d in json.loads((folder / "plan.json").read_text())["decisions"]}


def test_a_run_leaves_references_and_a_refined_avatar(train: Train, green: Green) -> None:
    folder, metrics = train(*SHORT, "refine.references.source=prior")
    plan = json.loads((folder / "plan.json").read_text())
    manifest = json.loads((folder / "inpainted" / "manifest.json").read_text())
    assert 0 < green.asked == len(manifest["frames"]) < plan["scene"]["frames"], (
        "whole frames are not inpainted"
    )
    assert manifest["identity"]["inpainter"] == "green"
    for name, record in manifest["frames"].items():
        picture = read_rgb(folder / "inpainted" / f"{name}.png")
        region = read_mask(folder / "inpainted" / "regions" / f"{name}.png")
        assert region.sum() == record["region_pixels"]
        assert (picture[region] == (0, 255, 0)).all()
    assert not torch.equal(parameters(folder)["gaussians.sh0"], parameters(folder, "optim")["gaussians.sh0"])
    assert metrics["train_seconds"]["refine"] > 0
    assert decisions(folder)["loss term gen in refine"]["used"]
    assert not decisions(folder)["loss term lpips in refine"]["used"]
    assert not decisions(folder)["full mask term on hidden pixels in refine"]["used"]


def test_references_may_count_only_where_nothing_is_known(
    train: Train, green: Green, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the scene has few pixels for each Gaussian: any is enough here
    monkeypatch.setattr("occfusion.inpaint.accumulation.ENOUGH", 0.01)
    folder, _ = train(*SHORT, "refine.references.source=prior", "refine.references.pixels=unseen")
    records = json.loads((folder / "inpainted" / "manifest.json").read_text())["frames"]
    assert all(record["region_pixels"] <= record["painted_pixels"] for record in records.values())
    painted, counting = (
        sum(record[f"{name}_pixels"] for record in records.values()) for name in ("painted", "region")
    )
    assert 0 < counting < painted
    name = next(name for name, record in records.items() if record["inpainted"])
    picture = read_rgb(folder / "inpainted" / f"{name}.png")
    assert (picture == (0, 255, 0)).all(axis=2).sum() >= records[name]["painted_pixels"]


def test_of_a_long_sequence_what_training_sees_is_made(train: Train) -> None:
    """Three steps of the refinement see three of ten frames, and two masks are completed."""
    few = ("optim.steps=5", "refine.steps=3", "init.max_frames=2")
    folder, _ = train(*SHORT, *few, "refine.hidden.target=outline", "optim.hidden.target=none")
    assert len(list((folder / "masks").glob("*.png"))) == 2
    assert "2 of " in decisions(folder)["complete masks"]["reason"]
    records = json.loads((folder / "inpainted" / "manifest.json").read_text())["frames"]
    seen = {f"{StepSampler(10, 0).position_at(step):06d}" for step in range(3)}
    assert records and set(records) <= seen
    assert (folder / "refine" / "avatar.safetensors").is_file()


def test_a_frame_of_which_no_pixel_counts_is_not_inpainted(
    train: Train, green: Green, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("occfusion.inpaint.partial.KNOWN", 0.0)  # nothing is unknown
    folder, _ = train(*SHORT, "refine.references.source=prior", "refine.references.pixels=unseen")
    records = json.loads((folder / "inpainted" / "manifest.json").read_text())["frames"]
    assert green.asked == 0 and records
    assert not any(record["inpainted"] or record["region_pixels"] for record in records.values())
    pictures = [read_rgb(folder / "inpainted" / f"{name}.png") for name in records]
    assert all(picture.any() and not (picture == (0, 255, 0)).all(axis=2).any() for picture in pictures)
    assert (
        f"0 of 10 frames inpainted, {len(records)} left as the avatar shows them" in capsys.readouterr().out
    )


def test_references_are_made_once(train: Train, green: Green) -> None:
    folder, _ = train(*SHORT, "refine.references.source=prior")
    asked = green.asked
    (folder / "refine" / "stage.json").unlink()
    (folder / "finished.json").unlink()
    train(*SHORT, "refine.references.source=prior")
    assert green.asked == asked


def test_a_stopped_inpainting_continues_behind_the_last_frame(
    train: Train, green: Green, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = Green.inpaint
    guards: list[SignalGuard] = []
    enter = SignalGuard.__enter__
    monkeypatch.setattr(SignalGuard, "__enter__", lambda self: (guards.append(self), enter(self))[1])

    def stops_after_two(self: Green, partial: Partial) -> Picture:
        if self.asked == 1:
            guards[-1].received = 15
        return original(self, partial)

    with monkeypatch.context() as patch:
        patch.setattr(Green, "inpaint", stops_after_two)
        with pytest.raises(Interrupted, match="inpainted"):
            train(*SHORT, "refine.references.source=prior")
    assert green.asked in (2, 3)  # one frame is read ahead
    folder, _ = train(*SHORT, "refine.references.source=prior")
    manifest = json.loads((folder / "inpainted" / "manifest.json").read_text())
    assert green.asked == len(manifest["frames"])


def test_stopped_and_resumed_refinement_equals_an_uninterrupted_one(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit-equal, with a round of densification after the resume."""
    options = [*SHORT, "refine.densification.after_step=3", "refine.densification.every=4", "refine.steps=9"]
    whole, _ = train(*options, folder="whole")
    original = SignalGuard.on_train_batch_end

    def stop_after_three(self: SignalGuard, trainer: Any, *rest: Any) -> None:
        if trainer.global_step == 3 and trainer.max_steps == 9:
            self.received = 15
        original(self, trainer, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(SignalGuard, "on_train_batch_end", stop_after_three)
        with pytest.raises(Interrupted, match="refine"):
            train(*options, folder="parts")
    parts, _ = train(*options, folder="parts")
    a, b = parameters(whole), parameters(parts)
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


def test_what_is_kept_of_an_avatar_follows_each_step(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    """Skinning weights are kept for as long as no parameter changes, which torch's fused step does not tell."""
    versions: list[tuple[int, ...]] = []
    original = AvatarStage.on_train_batch_end

    def record(self: AvatarStage, *rest: Any) -> None:
        versions.append(tuple(p._version for p in self.avatar.gaussians.parameters() if p.grad is not None))
        original(self, *rest)

    monkeypatch.setattr(AvatarStage, "on_train_batch_end", record)
    train(*SHORT, "stage=optim")
    assert len(versions) == 4 and versions[0]
    assert all(a < b for before, after in pairwise(versions) for a, b in zip(before, after, strict=True))


def test_the_hand_over_does_not_stall(train: Train, green: Green) -> None:
    """After 100 steps towards one colour, what is hidden has moved by a tenth of rate x steps at least.

    The optimisation's loss is 1e4 times larger: with its second moments, Adam would hardly move.
    """
    folder, _ = train(
        *SHORT, "refine.references.source=prior", "optim.steps=30", "refine.steps=100", "refine.lambda_rgb=0",
        "refine.lambda_mask=0", "refine.densify=false", "optim.rates.opacity=0", *UNMEASURED,
    )  # fmt: skip
    before, after = (parameters(folder, stage)["gaussians.sh0"][:, 0, 1] for stage in ("optim", "refine"))
    moved = (after - before).sort(descending=True).values
    assert moved[: len(moved) // 20].mean() > 0.1 * 100 * 2.5e-3


def test_scaling_all_weights_changes_nothing(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    """Adam does not see a common factor of the loss, nor does densification; one of two is exact but for Adam's floor.

    The floor is lowered for the test: round Gaussians have gradients of their rotation as small as it.
    """
    monkeypatch.setattr("occfusion.stages.avatar.ADAM_EPS", 1e-18)
    options = [
        *SHORT,
        "refine.densification.after_step=3",
        "refine.densification.every=4",
        "refine.steps=6",
        *UNMEASURED,
    ]
    # exact in binary, and large: round Gaussians turn by rounding alone, and squares under 1e-38 are 0 in float32
    weights = {
        "lambda_rgb": 2.0**20,
        "lambda_mask": 2.0**22,
        "references.weight": 2.0**17,
        "lambda_ssim": 2.0**18,
    }
    options += [f"refine.{name}={weight}" for name, weight in weights.items()]
    scaled = [f"refine.{name}={2.0**10 * weight}" for name, weight in weights.items()]
    a, _ = train(*options, folder="a")
    b, _ = train(*options, *scaled, folder="b")
    first, second = parameters(a), parameters(b)
    assert len(first["gaussians.means"]) != 6890, "densification has worked"
    for name in first:
        assert len(first[name]) == len(second[name])
        apart = (first[name].double() - second[name].double()).abs()
        assert int((apart > 1e-5 + 1e-4 * first[name].abs()).sum()) <= 1e-3 * apart.numel(), (
            name
        )  # no band: no number


def test_an_unoccluded_scene_is_neither_completed_nor_inpainted(
    train: Train, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its avatar is refined all the same: more steps and Gaussians help it as much as any other."""

    def fail(*_: object) -> None:
        raise AssertionError("a prior was loaded although nothing is hidden")

    for place in (
        "init.make_mask_prior", "refine.make_inpainter", "optim.make_score_prior",
        "prepare.check_inpainter", "prepare.check_score_prior",
    ):  # fmt: skip
        monkeypatch.setattr(f"occfusion.run.{place}", fail)
    folder, metrics = train(*SHORT, "refine.references.source=prior", "dataset.occlusion.kind=none")
    assert not (folder / "masks").exists() and not (folder / "inpainted").exists()
    assert (folder / "refine" / "avatar.safetensors").is_file()
    left_out = {
        "stage init",
        "inpainting",
        "loss term gen in refine",
        "full mask term on hidden pixels in refine",
        "loss term sds_pose",
        "loss term sds_can",
    }
    assert left_out <= set(metrics["left_out"]) and "stage refine" not in metrics["left_out"]
    for part in left_out:
        assert "0 of 10 training frames" in decisions(folder)[part]["reason"], part
    assert "none of 10 frames is occluded, none is inpainted" in capsys.readouterr().out


def test_plan_full_does_everything(train: Train, green: Green) -> None:
    folder, metrics = train(
        *SHORT, "refine.references.source=prior", "dataset.occlusion.kind=none", "plan=full"
    )
    assert green.asked == 10
    assert (folder / "refine" / "avatar.safetensors").is_file()
    assert len(list((folder / "masks").glob("*.png"))) == 10
    assert not {"stage init", "stage refine", "inpainting"} & set(metrics["left_out"])


def test_missing_references_are_made_again(
    train: Train, green: Green, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = train(*SHORT, "refine.references.source=prior")
    (folder / "refine" / "stage.json").unlink()
    (folder / "refine" / "last.ckpt").unlink()
    (folder / "finished.json").unlink()
    regions, asked = list((folder / "inpainted" / "regions").glob("*.png")), green.asked
    for region in regions:
        region.unlink()
    train(*SHORT, "refine.references.source=prior")
    assert asked > 0 and green.asked == 2 * asked and all(region.is_file() for region in regions)
    assert f"{asked} pictures in {folder / 'inpainted'} are not as they were left" in capsys.readouterr().out


def test_tables_that_a_killed_process_did_not_keep_with_the_stage_are_kept_by_the_next(train: Train) -> None:
    """It was killed between the stage's last file and the copies of its tables."""
    folder, _ = train(*SHORT, "stage=optim")
    losses = (folder / "losses.csv").read_bytes()
    assert (folder / "optim" / "losses.csv").read_bytes() == losses
    (folder / "optim" / "losses.csv").unlink()
    (folder / "finished.json").unlink()
    train(*SHORT, "stage=optim")
    assert (folder / "optim" / "losses.csv").read_bytes() == losses == (folder / "losses.csv").read_bytes()


def test_a_reference_that_goes_missing_meanwhile_is_named(tmp_path: Path) -> None:
    frame = Frame.__new__(Frame)
    object.__setattr__(frame, "index", 7)
    with pytest.raises(DataError, match=r"000007\.png: the reference of this frame is missing"):
        References(RunFolder(tmp_path).inpainted, frozenset({7})).get(frame, (0, 0, 1, 1))


def test_what_no_frame_shows_is_painted_at_the_handover_where_nothing_is_hidden(
    train: Train, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The optimisation moves such colours, by what shines through; the refinement begins with completed ones again."""
    paint = repaint_unseen

    def spoilt(training: AvatarTraining, avatar: Avatar) -> Accumulated:
        with torch.no_grad():
            avatar.gaussians.sh0.fill_(1.7)  # the optimisation left white
        return paint(training, avatar)

    monkeypatch.setattr("occfusion.run.refine.repaint_unseen", spoilt)
    monkeypatch.setattr("occfusion.plan.decisions.TURNED", 180.0)  # the person turns
    folder, _ = train(
        "variant=E", "dataset.occlusion=none", "optim.unseen_colors=prior", "optim.steps=2", "refine.steps=1",
        "optim.sds.lambda_pose=0", "optim.sds.lambda_can=0", "refine.densify=false", *UNMEASURED,
    )  # fmt: skip
    assert "frames is occluded, none is inpainted" in capsys.readouterr().out
    completion = np.load(folder / "completion.npz", allow_pickle=False)
    avatar = load_run(folder).avatar
    found = (avatar.gaussians.sh0.detach()[:, 0] * SH_C0 + 0.5).numpy()
    vertices = avatar.gaussians.vertex_index.numpy()
    known = completion["seen"][vertices]
    unseen, seen = known < 0.02, known > np.quantile(known, 0.9)
    away = np.abs(found - completion["colors"][vertices].astype(np.float32)).mean(axis=1)
    assert unseen.mean() > 0.05
    assert np.median(away[unseen]) < 0.03
    assert np.median(away[seen]) > 0.2, "what is seen stays as it was learned"
