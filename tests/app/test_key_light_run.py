"""Embedded people under a known lamp: it is found from one camera, and the whole system renders by its light."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from occfusion.observation.key_light import find_key_light
from occfusion.run import app
from occfusion.run.loaded import load_run
from occfusion.run.prepare import make_body, make_data, observe_training_frames
from occfusion.synth import SceneSpec, write_scene
from occfusion.synth.light import AMBIENT, KEY_DIRECTION

CONF = Path(__file__).parents[2] / "conf"
SPEC = SceneSpec(subject=5, image_size=96, frames=50, cameras=2)


def train(root: Path, spec: SceneSpec, *overrides: str) -> Path:
    write_scene(root, spec, progress=False)
    fixed = [
        "dataset=zju", f"dataset.root={root}", f"dataset.scene={spec.name}", f"output_dir={root / 'run'}",
        f"body.path={root / spec.name / 'body.npz'}", "trainer.enable_progress_bar=false", "trainer.max_steps=2",
        "optim.lambda_lpips=0", "refine.lambda_lpips=0", "evaluation.held_out=false", "evaluation.curve=false",
        "evaluation.training_views=false", "evaluation.perceptual=false", "dataset.test_frames=[0,10,9]",
        "optim.align_poses=false", "optim.unseen_colors=nearest",
    ]  # fmt: skip
    with initialize_config_dir(str(CONF), version_base="1.3"):
        app.run(compose("config", [*fixed, *overrides]), folder_chosen_by_user=True)
    return root / "run"


@pytest.mark.parametrize(
    ("light", "occlusion"), [("soft", "strip"), ("soft", "none"), ("directional", "strip")]
)
def test_the_lamp_of_a_scene_is_found_and_kept_with_the_avatar(
    tmp_path: Path, light: str, occlusion: str
) -> None:
    folder = train(
        tmp_path,
        replace(SPEC, light=light),
        "stage=optim",
        "init.source=truth",
        f"dataset.occlusion.kind={occlusion}",
    )
    plan = {d["part"]: d for d in json.loads((folder / "plan.json").read_text())["decisions"]}
    assert plan["key light"]["used"] and "explains" in plan["key light"]["reason"]
    vector = load_run(folder).avatar.key_light
    assert vector is not None
    strength = float(vector.norm())
    angle = math.degrees(math.acos(float(vector.double() @ torch.from_numpy(KEY_DIRECTION)) / strength))
    ambient = AMBIENT[light]
    assert angle < 15.0
    assert 0.6 < strength / ((1.0 - ambient) / ambient) < 1.3


def test_without_a_lamp_nothing_is_looked_for(tmp_path: Path) -> None:
    folder = train(tmp_path, SPEC, "variant=A", "optim.key_light=false")
    plan = {d["part"]: d for d in json.loads((folder / "plan.json").read_text())["decisions"]}
    assert not plan["key light"]["used"]
    run = load_run(folder)
    assert run.avatar.key_light is None
    body = make_body(run.settings.body)
    data = make_data(run.settings, body)
    data.setup()
    observed_frames = observe_training_frames(data, body)
    few = find_key_light(lambda k: data.train_frame(k, truth=False), observed_frames[:3], body.faces.numpy())
    assert few is None  # three frames, none of which shows a point five times
    assert np.isfinite([m.vertices for m in observed_frames]).all()
