"""Runs with the Stable Diffusion prior in each of its places, models tiny and random."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from occfusion.errors import DataError
from occfusion.files.images import read_mask
from tiny_sd15 import write_tiny_controlnet, write_tiny_inpainting, write_tiny_models

Train = Callable[..., tuple[Path, dict[str, Any]]]
STAGE = ("variant=B", "stage=init", "trainer.fast_dev_run=true")


@pytest.mark.parametrize("preset", ["sd15", "sd15_code"])
def test_fast_dev_run_of_the_init_stage(train: Train, tmp_path: Path, preset: str) -> None:
    models = [f"prior.{key}={folder}" for key, folder in write_tiny_models(tmp_path / "models").items()]
    folder, _ = train(*STAGE, f"prior={preset}", *models, "prior.resolution=64", "prior.steps=2")
    manifest = json.loads((folder / "masks" / "manifest.json").read_text())
    assert manifest["identity"]["prior"] == "sd15"
    assert ("two arms" in manifest["identity"]["prompt"]) == (preset == "sd15_code")
    (name,) = manifest["frames"]
    assert manifest["frames"][name]["status"] == "completed"
    assert read_mask(folder / "masks" / f"{name}.png").any()


def test_without_weights_nothing_is_started(train: Train, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"prior\.inpainting=.*nowhere: there is no such folder.*hf download"):
        train(*STAGE, "prior=sd15", f"prior.inpainting={tmp_path / 'nowhere'}")
    assert not (tmp_path / "run" / "masks").exists()


def test_score_distillation_on_latents(train: Train, tmp_path: Path) -> None:
    write_tiny_inpainting(tmp_path / "model", channels_in=4)
    write_tiny_controlnet(tmp_path / "controlnet")
    models = [f"prior.score.{name}={tmp_path / name}" for name in ("model", "controlnet")]
    options = ("variant=D", "prior=sd15", "sds=code", "init.source=truth", "optim.steps=2", *models)
    folder, _ = train(*options, "optim.sds.posed_probability=1", "dataset.occlusion.fraction=1")
    assert (folder / "optim" / "avatar.safetensors").is_file()


def test_models_of_the_score_are_looked_for_before_masks_are_made(train: Train, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"prior\.score\.model=.*no such folder"):
        train("variant=C", "prior=sd15", "init.source=truth", f"prior.score.model={tmp_path / 'nowhere'}")
    assert not (tmp_path / "run").exists()


def test_the_whole_system_with_models_of_all_places(train: Train, tmp_path: Path) -> None:
    models = [f"prior.{key}={folder}" for key, folder in write_tiny_models(tmp_path / "models").items()]
    write_tiny_inpainting(tmp_path / "model", channels_in=4)
    write_tiny_controlnet(tmp_path / "controlnet")
    models += [f"prior.score.{name}={tmp_path / name}" for name in ("model", "controlnet")]
    small = ("prior.resolution=64", "prior.steps=2", "prior.inpaint.resolution=64", "prior.inpaint.steps=2")
    folder, _ = train(
        "variant=E", "prior=sd15", "sds=code", "trainer.fast_dev_run=true", "refine.lambda_lpips=0",
        "dataset.occlusion.fraction=1", *models, *small,
    )  # fmt: skip
    manifest = json.loads((folder / "inpainted" / "manifest.json").read_text())
    identity = manifest["identity"]
    assert identity["inpainter"] == "sd15" and identity["inpainting_hash"] and identity["controlnet_hash"]
    assert identity["prompt"] == "the same person standing in two different rooms"
    assert identity["steps"] == 2 and identity["data"] and identity["avatar"]
    ((name, record),) = manifest["frames"].items()
    assert record["region_pixels"] > 0 and record["moved"] > 0
    assert (folder / "inpainted" / f"{name}.png").is_file()
    assert (folder / "refine" / "avatar.safetensors").is_file()


def test_models_of_the_inpainter_are_looked_for_before_masks_are_made(train: Train, tmp_path: Path) -> None:
    missing = f"prior.controlnet={tmp_path / 'nowhere'}"
    write_tiny_inpainting(tmp_path / "inpainting")
    options = (
        "variant=E", "prior=sd15", "init.source=truth", "optim.sds.lambda_pose=0", "optim.sds.lambda_can=0",
        f"prior.inpainting={tmp_path / 'inpainting'}",
    )  # fmt: skip
    with pytest.raises(DataError, match=r"prior\.controlnet=.*nowhere: there is no such folder.*hf download"):
        train(*options, missing)
    assert not (tmp_path / "run").exists()
    folder, _ = train(*options, missing, "refine.references.source=coarse", "stage=init")
    assert (folder / "masks").is_dir()
