"""The initialisation stage with the Stable Diffusion prior, models tiny and random."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from occfusion.errors import DataError
from occfusion.files.images import read_mask
from tiny_sd15 import write_tiny_models

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
