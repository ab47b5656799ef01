"""Training on layouts other than the original: the command line of each, from folder to figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from safetensors.torch import load_file

from data import layout_writers as writers
from data.layout_writers import Source
from occfusion.run import app
from occfusion.synth import SceneSpec, write_scene

CONF = Path(__file__).parents[2] / "conf"
LIGHT = (
    "trainer.enable_progress_bar=false", "optim.lambda_lpips=0", "evaluation.perceptual=false",
    "evaluation.curve_images=1", "evaluation.training_stride=2", "evaluation.turntable=0", "trainer.max_steps=3",
    "optim.steps=3", "optim.align_poses=false", "optim.unseen_colors=nearest",
)  # fmt: skip


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Source:
    spec = SceneSpec(1, "clean", image_size=96, frames=4, cameras=2)
    return Source(write_scene(tmp_path_factory.mktemp("scenes"), spec, progress=False))


def train(source: Source, folder: Path, *overrides: str) -> dict[str, Any]:
    body = f"body.path={source.folder / 'body.npz'}"
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", [body, f"output_dir={folder}", *LIGHT, *overrides])
    return app.run(config, folder_chosen_by_user=True)


def test_ocmotion_is_measured_on_visible_pixels(source: Source, tmp_path: Path) -> None:
    writers.write_w2a(source, tmp_path)
    metrics = train(
        source, tmp_path / "run", "dataset=ocmotion", f"dataset.root={tmp_path}", "dataset.scene=0013_02"
    )
    regions = metrics["regions"]
    assert metrics["dataset"] == "ocmotion" and metrics["images"] == 0
    # 21.5 dB; nobody there or a black person: 8.8, a person 0.4 m from its place: 9.4
    assert regions["visible"]["psnr"] > 17 and regions["visible"]["mask_iou"] is None
    assert regions["full"]["psnr"] is None and regions["hidden"]["psnr"] is None
    scene = json.loads((tmp_path / "run" / "plan.json").read_text())["scene"]
    assert scene["visible_share_is"] == "estimated" and scene["frames"] == 2  # every second of four


def test_video_with_held_out_frames(source: Source, tmp_path: Path) -> None:
    writers.write_video(source, tmp_path / "mine")
    metrics = train(
        source, tmp_path / "run", "dataset=video", f"dataset.root={tmp_path}", "dataset.scene=mine",
        "dataset.occluded=false", "dataset.test_cameras=[0]", "dataset.train_frames=[0,3,1]",
        "dataset.test_frames=[3,4,1]",
    )  # fmt: skip
    # 31.1 dB; nobody there or a black person: 20.3, a person 0.4 m from its place: 18.8
    assert metrics["images"] == 1 and metrics["regions"]["full"]["psnr"] > 27


def test_frames_in_which_somebody_else_hides_the_person(source: Source, tmp_path: Path) -> None:
    """Some frames have a truth and some have none: tables and pictures must do with both."""
    folder = writers.write_video(source, tmp_path / "crowd")
    for frame, path in enumerate(sorted((folder / "masks").iterdir())):
        numbers = source.mask(frame) * np.uint8(3)
        if frame == 1:
            rows = np.flatnonzero(numbers.any(axis=1))
            numbers[rows.mean().astype(int) :][numbers[rows.mean().astype(int) :] > 0] = 5
        assert cv2.imwrite(str(path), numbers)
    metrics = train(
        source, tmp_path / "run", "dataset=video", f"dataset.root={tmp_path}", "dataset.scene=crowd",
        "dataset.person=3", "dataset.occluded=false", "dataset.test_cameras=[0]", "dataset.test_frames=[0,4,1]",
        "evaluation.training_stride=1",
    )  # fmt: skip
    regions = metrics["regions"]
    assert (
        regions["full"]["images"] == 3 and regions["visible"]["images"] == 4
    )  # nobody knows what the second hides
    assert regions["visible"]["mask_iou"] > 0.3 and regions["hidden"]["images"] == 0
    views = json.loads((tmp_path / "run" / "pictures" / "training.json").read_text())["views"]
    assert sorted(len(view["parts"]) for view in views) == [2] + [4] * (len(views) - 1)
    picture = cv2.imread(str(tmp_path / "run" / "pictures" / "training.png"))
    assert picture.shape[1] == 4 * 96
    summary = json.loads((tmp_path / "run" / "plan.json").read_text())["scene"]
    assert summary["occluded_frames"] == 1 and summary["visible_share"]["1"] < 0.8


@pytest.mark.slow
def test_every_layout_takes_the_same_first_steps(source: Source, tmp_path: Path) -> None:
    writers.write_refined(source, tmp_path)
    writers.write_humannerf(source, tmp_path / "plain")
    writers.write_w2a(source, tmp_path)
    writers.write_video(source, tmp_path / "mine")
    writers.write_stamped(source, tmp_path)
    writers.write_chomp(source, tmp_path / "raw")
    shared = ("dataset.train_frames=[0,4,1]", "dataset.occlusion.kind=none", "evaluation.held_out=false",
              "evaluation.curve=false", "evaluation.pictures=false", "evaluation.training_views=false")  # fmt: skip
    runs = {
        "original": (
            "dataset=zju",
            f"dataset.root={source.folder.parent}",
            f"dataset.scene={source.folder.name}",
        ),
        "refined": ("dataset=zju", f"dataset.root={tmp_path}", "dataset.scene=my_377"),
        "313": ("dataset=zju", f"dataset.root={tmp_path}", "dataset.scene=CoreView_313"),
        "humannerf": ("dataset=zju", f"dataset.root={tmp_path}", "dataset.scene=plain"),
        "w2a": (
            "dataset=ocmotion", f"dataset.root={tmp_path}", "dataset.scene=0013_02", "dataset.image_size=512",
        ),
        "chomp": (
            "dataset=ocmotion", f"dataset.root={tmp_path / 'raw'}", "dataset.scene=0013_02",
            "dataset.numbered_masks=true", "dataset.person=1", "dataset.image_size=512",
        ),
        "video": ("dataset=video", f"dataset.root={tmp_path}", "dataset.scene=mine"),
    }  # fmt: skip
    states = {}
    for name, overrides in runs.items():
        train(source, tmp_path / "runs" / name, *overrides, *shared)
        states[name] = load_file(tmp_path / "runs" / name / "optim" / "avatar.safetensors")
    for name, state in states.items():
        assert state.keys() == states["original"].keys()
        for key, value in state.items():
            wanted = states["original"][key]
            if value.is_floating_point() and value.numel():
                close = torch.isclose(value, wanted, rtol=1e-3, atol=1e-5).float().mean()
                assert close > 0.999, f"{name}, {key}: {close:.4f}"
