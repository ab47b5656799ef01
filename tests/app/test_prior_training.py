"""`stage=prior`: both tasks on tiny corpora."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from occfusion.errors import ConfigError, DataError
from occfusion.inpaint.appearance_net import (
    COARSE,
    DEPTH,
    PLANES,
    SIZE,
    VISIBLE,
    load_appearance_net,
    take_planes,
)
from occfusion.inpaint.partial import CoarsePictures, Partial, Picture
from occfusion.prior_training.appearance_batches import Example
from occfusion.prior_training.appearance_task import VERSION, AppearanceTask, coarse_scenes
from occfusion.prior_training.example_shard import ExampleShard
from occfusion.priors.embedded.network_file import save_net
from occfusion.priors.embedded.silhouette_net import load_silhouette_net
from occfusion.settings.stages import PriorTrainingSettings
from peak_memory import PeakMemory

Train = Callable[..., tuple[Path, dict[str, Any]]]
TINY = ("stage=prior", "prior_training.widths=[8,16]", "prior_training.depth=1")


def small_scene(tmp_path: Path) -> list[str]:
    """An embedded person in five frames of 64 pixels, two steps of optimisation."""
    return [
        "dataset=synthetic", "body=anny", "body.path=null", "dataset.image_size=64", "dataset.frames=5",
        f"dataset.root={tmp_path / 'made'}", "optim.steps=2", "dataset.test_frames=null",
    ]  # fmt: skip


def test_the_silhouette_prior_ends_in_weights(train: Train) -> None:
    folder, card = train(*TINY, "prior_training=silhouette", "trainer.fast_dev_run=true")
    net, read = load_silhouette_net(folder / "prior.safetensors")
    assert read["training"] == card["training"] and card["training"]["steps"] == 1
    header, row = (folder / "losses.csv").read_text().splitlines()
    assert header == "stage,step,total,v,rate_net" and row.startswith("prior,1,")
    assert sum(parameter.numel() for parameter in net.parameters()) > 1000


def test_the_appearance_prior_trains_its_coarse_avatars_once(
    tmp_path: Path, train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = [
        *TINY,
        *small_scene(tmp_path),
        "prior_training=appearance",
        "prior_training.subjects=1",
        "variant=B",
    ]
    options += ["prior_training.batch=2", "prior_training.steps=2"]
    folder, card = train(*options, "trainer.fast_dev_run=false")
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

    monkeypatch.setattr("occfusion.run.prior.train_coarse", fail)
    again = train(*options)[1]
    assert again["validation"] == pytest.approx(card["validation"], rel=1e-4), (
        "a finished run lost its figures"
    )


class Recorder(CoarsePictures):
    """Keeps what the refinement asks about."""

    def __init__(self) -> None:
        self.planes: dict[str, NDArray[np.float32]] = {}

    def inpaint(self, partial: Partial) -> Picture:
        self.planes[partial.observation.name] = take_planes(partial)[1]
        return partial.coarse


def test_the_corpus_shows_what_the_refinement_asks_about(
    tmp_path: Path, train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Coarse renderings of the corpus are those of the variant that refines: its optimisation, its hand-over."""
    folder, _ = train(
        *TINY, *small_scene(tmp_path), "prior_training=appearance", "prior_training.subjects=1", "variant=E",
        "prior_training.batch=2", "prior_training.steps=1", folder="prior",
    )  # fmt: skip
    (scene,) = coarse_scenes(1)
    shard = np.load(folder / "corpus" / scene.scene / "planes.npy")
    recorder = Recorder()
    monkeypatch.setattr("occfusion.run.refine._make_inpainter", lambda *_: recorder)
    how = {"kind": scene.occlusion, "share": scene.share, "fraction": scene.fraction}
    train(
        *small_scene(tmp_path), "variant=E", "stage=refine", f"refine.steps={scene.frames}", "dataset.cameras=2",
        f"dataset.scene={scene.scene}", f"dataset.train_frames=[0,{scene.frames},1]", f"seed={scene.seed}",
        *(f"dataset.occlusion.{key}={value}" for key, value in how.items()), "dataset.test_frames=[0,1,1]",
        "evaluation.curve=false", folder="whole",
    )  # fmt: skip
    asked = np.stack([recorder.planes[name] for name in sorted(recorder.planes)])
    asked[:, DEPTH] = 0.5 * (asked[:, DEPTH] + 1.0)
    assert len(asked) == len(shard) > 0
    assert (asked[:, VISIBLE] < 0.5).any() and asked[:, COARSE].max() > 0.2
    np.testing.assert_allclose(shard / 255.0, asked, atol=0.51 / 255.0)


def test_a_variant_that_inpaints_nothing_has_no_corpus(tmp_path: Path, train: Train) -> None:
    with pytest.raises(ConfigError, match="variant A completes no masks"):
        train(*TINY, *small_scene(tmp_path), "prior_training=appearance", "variant=A")


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
    task = AppearanceTask(settings, tmp_path, 0, "same", fail)  # type: ignore[arg-type]
    for number, scene in enumerate(coarse_scenes(3)):
        shard = tmp_path / scene.scene
        shard.mkdir()
        planes = np.full((2, len(PLANES), SIZE, SIZE), 100 * number, np.uint8)
        np.save(shard / "planes.npy", planes)
        np.save(shard / "truth.npy", planes[:, :3])
        np.save(shard / "mask.npy", planes[:, 0])
        identity = {"version": VERSION, "size": SIZE, "made_by": "same", **vars(scene)}
        (shard / "shard.json").write_text(json.dumps(identity))
    task.prepare()
    for step in range(4):
        assert (task.batch(step).conditions[:, 3] > 0.5).all()
    stranger = AppearanceTask(settings, tmp_path, 0, "other", fail)  # type: ignore[arg-type]
    with pytest.raises(AssertionError):
        stranger.prepare()


def test_weights_of_another_version_are_refused(tmp_path: Path) -> None:
    """Weights that were trained for another signal would paint wrong colours without a word."""
    net, card = load_appearance_net()
    card = {key: value for key, value in card.items() if key != "sha256"}
    path = tmp_path / "old.safetensors"
    save_net(path, net, "appearance", SIZE, card["widths"], card["depth"], card, version=1)
    with pytest.raises(
        DataError, match=r"old.safetensors: weights of version 1 of the appearance prior, not 2"
    ):
        load_appearance_net(path)
    save_net(path, net, "appearance", SIZE, card["widths"], card["depth"], card, version=2)
    load_appearance_net(path)


def test_examples_pass_through_a_shard_one_by_one(tmp_path: Path) -> None:
    """A scene's were gathered in memory and copied; read from mapped files, all that was read counted as memory."""
    count, shape = 24, (len(PLANES), SIZE, SIZE)

    def example(k: int) -> Example:
        rng = np.random.default_rng(k)
        return Example(
            *(rng.integers(0, 256, form, np.uint8) for form in (shape, (3, SIZE, SIZE), (SIZE, SIZE)))
        )

    shard = ExampleShard(tmp_path / "shard")
    with PeakMemory() as peak:
        shard.write((example(k) for k in range(count)), count)
        read = [int(shard.read(k).truth[0, 0, 0]) for k in range(count)]
    assert peak.megabytes < 0.4 * count * np.prod(shape) / 1e6, "at most a few of them at a time"
    assert len(shard) == len(read) == count
    whole = {name: np.load(tmp_path / "shard" / f"{name}.npy") for name in ("planes", "truth", "mask")}
    for k in (0, 7, count - 1):
        for name, rows in whole.items():
            assert np.array_equal(getattr(shard.read(k), name), getattr(example(k), name))
            assert np.array_equal(rows[k], getattr(example(k), name))
    for wrong in (0, 3, 30):
        with pytest.raises(DataError, match=f"24 examples of {wrong}|0 examples of 0"):
            shard.write((example(0) for _ in range(24 if wrong else 0)), wrong)
    shard.write((example(k) for k in range(2)), 2)
    (tmp_path / "shard" / "truth.npy").write_bytes((tmp_path / "shard" / "truth.npy").read_bytes()[:-9])
    with pytest.raises(DataError, match="cut short; remove the folder"):
        shard.read(1)
