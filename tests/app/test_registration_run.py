"""Pictures shifted against their cameras, in whole runs: measured, corrected, said, and left alone on request."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir

from data import layout_writers as writers
from data.layout_writers import Source
from occfusion.run import app
from occfusion.synth import SceneSpec, write_scene

CONF = Path(__file__).parents[2] / "conf"
LIGHT = (
    "dataset=zju", "variant=A", "trainer.enable_progress_bar=false", "optim.lambda_lpips=0", "optim.steps=1",
    "evaluation.perceptual=false", "evaluation.curve=false", "evaluation.training_views=false",
    "evaluation.pictures=false",
)  # fmt: skip
SHIFT = 2.0


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Source:
    spec = SceneSpec(1, "clean", image_size=96, frames=20, cameras=3)
    return Source(write_scene(tmp_path_factory.mktemp("scenes"), spec, progress=False))


def train(scene: Source, tmp_path: Path, shifted: tuple[int, ...], *overrides: str) -> tuple[dict, dict]:
    """Shifts the principal points of some cameras; returns the decision on them and the run's environment."""
    for camera in shifted:
        scene.cams["K"][camera] = np.array(scene.cams["K"][camera]) + SHIFT * np.array(
            [[0, 0, 1], [0, 0, 0], [0, 0, 0]]
        )
    writers.save_object(scene.folder / "annots.npy", scene.annots)
    command = [*LIGHT, f"dataset.root={scene.folder.parent}", f"dataset.scene={scene.folder.name}",
               f"body.path={scene.folder / 'body.npz'}", f"output_dir={tmp_path / 'run'}", *overrides]  # fmt: skip
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            app.run(compose("config", command), folder_chosen_by_user=True)
    finally:
        for camera in shifted:
            scene.cams["K"][camera] = np.array(scene.cams["K"][camera]) - SHIFT * np.array(
                [[0, 0, 1], [0, 0, 0], [0, 0, 0]]
            )
        writers.save_object(scene.folder / "annots.npy", scene.annots)
    plan = json.loads((tmp_path / "run" / "plan.json").read_text())
    (decision,) = [d for d in plan["decisions"] if d["part"] == "camera correction"]
    return decision, json.loads((tmp_path / "run" / "environment.json").read_text())


def test_all_cameras_of_a_wrong_convention_are_corrected(scene, tmp_path, capsys):
    decision, environment = train(scene, tmp_path, (0, 1, 2))
    assert decision["used"] and "in all cameras" in decision["reason"], decision
    said = capsys.readouterr().out
    found = re.search(r"camera correction: yes; pictures lie \((-?\d+\.\d+) ", said)
    assert found is not None and float(found[1]) == pytest.approx(-SHIFT, abs=0.1), said
    assert "data\n  layout: " in said and "plan\n  stages: optim" in said
    assert environment["data"]["cameras"] and environment["data"]["layout"]


def test_the_training_camera_alone_is_corrected_where_others_are_right(scene, tmp_path):
    decision, _ = train(scene, tmp_path, (0,))
    assert decision["used"] and "in the training camera alone" in decision["reason"], decision


def test_a_focal_length_that_is_off_alone_is_corrected(scene, tmp_path):
    """No shift comes with it, for other cameras to confirm."""
    right = np.array(scene.cams["K"][0])
    scene.cams["K"][0] = right * np.array([[1.03, 1, 1], [1, 1.03, 1], [1, 1, 1]])
    try:
        decision, _ = train(scene, tmp_path, ())
    finally:
        scene.cams["K"][0] = right
        writers.save_object(scene.folder / "annots.npy", scene.annots)
    assert decision["used"] and "in the training camera alone" in decision["reason"], decision
    found = re.search(r"and (0\.9\d+), in the training", decision["reason"])
    assert found is not None and float(found[1]) == pytest.approx(1 / 1.03, abs=4e-3)


def test_exact_cameras_are_left_alone(scene, tmp_path):
    decision, _ = train(scene, tmp_path, ())
    assert not decision["used"] and "nothing is certainly off" in decision["reason"], decision


def test_it_can_be_turned_off(scene, tmp_path):
    decision, _ = train(scene, tmp_path, (0, 1, 2), "registration=off")
    assert not decision["used"] and "registration = off" in decision["reason"]
