"""`stage=prior`: both recipes on tiny corpora."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from occfusion.errors import ConfigError
from occfusion.inpaint.planes import PLANES, SIZE
from occfusion.inpaint.weights import load_appearance_net
from occfusion.priors.weights import load_silhouette_net
from occfusion.recipes.appearance import AppearanceRecipe, coarse_scenes
from occfusion.stages.settings import PriorTrainingSettings

Train = Callable[..., tuple[Path, dict[str, Any]]]
TINY = ("stage=prior", "prior_training.widths=[8,16]", "prior_training.depth=1")


def test_the_silhouette_recipe_ends_in_weights(train: Train) -> None:
    folder, card = train(*TINY, "prior_training=silhouette", "trainer.fast_dev_run=true")
    net, read = load_silhouette_net(folder / "prior.safetensors")
    assert read["training"] == card["training"] and card["training"]["steps"] == 1
    assert sum(parameter.numel() for parameter in net.parameters()) > 1000


def test_the_appearance_recipe_trains_its_coarse_avatars_once(
    tmp_path: Path, train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = [*TINY, "prior_training=appearance", "prior_training.subjects=1", "prior_training.batch=2"]
    options += [
        "dataset=synthetic",
        "body=anny",
        "body.path=null",
        "dataset.image_size=64",
        "dataset.frames=5",
    ]
    options += [f"dataset.root={tmp_path / 'made'}", "optim.steps=2", "dataset.test_frames=null"]
    folder, card = train(*options, "prior_training.steps=2", "trainer.fast_dev_run=false")
    net, _ = load_appearance_net(folder / "prior.safetensors")
    assert torch.isfinite(
        net(torch.zeros(1, 3, 16, 16), torch.ones(1), torch.zeros(1, len(PLANES), 16, 16))
    ).all()
    (scene,) = (path.parent for path in folder.glob("corpus/*/shard.json"))
    planes = np.load(scene / "planes.npy")
    assert planes.shape[1:] == (len(PLANES), SIZE, SIZE)
    with (folder / "error_vs_time.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert float(row["coarse_psnr"]) == card["validation"]["coarse_psnr"] > 5

    def fail(*_: object) -> None:
        raise AssertionError("a coarse avatar was trained again")

    monkeypatch.setattr("occfusion.app.train_coarse", fail)
    train(*options, "prior_training.steps=2")


def test_other_settings_are_another_run(train: Train) -> None:
    train(*TINY, "prior_training=silhouette", "prior_training.steps=1", "prior_training.examples=4",
          "prior_training.validation=4", "prior_training.batch=2")  # fmt: skip
    with pytest.raises(ConfigError, match="other settings"):
        train(*TINY, "prior_training=silhouette", "prior_training.steps=2", "prior_training.examples=4")


def test_scenes_are_never_held_out() -> None:
    assert all(int(scene.scene[:3]) < 100 for scene in coarse_scenes(95))
    with pytest.raises(ConfigError, match="subjects: 96"):
        coarse_scenes(96)


def test_validation_subjects_are_not_trained_on(tmp_path: Path) -> None:
    """A batch never shows the first two shards when there are more."""

    def fail(*_: object) -> None:
        raise AssertionError

    settings = PriorTrainingSettings(network="appearance", batch=8, subjects=3)
    recipe = AppearanceRecipe(settings, tmp_path, 0, fail)  # type: ignore[arg-type]
    for number, scene in enumerate(coarse_scenes(3)):
        shard = tmp_path / scene.scene
        shard.mkdir()
        planes = np.full((2, len(PLANES), SIZE, SIZE), 100 * number, np.uint8)
        np.save(shard / "planes.npy", planes)
        np.save(shard / "truth.npy", planes[:, :3])
        np.save(shard / "mask.npy", planes[:, 0])
        identity = {"version": 1, "size": SIZE, **vars(scene)}
        (shard / "shard.json").write_text(json.dumps(identity))
    recipe.prepare()
    for step in range(4):
        assert (recipe.batch(step).conditions[:, 3] > 0.5).all()
