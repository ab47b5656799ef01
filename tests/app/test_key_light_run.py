"""Embedded people under a known lamp: it is found from one camera, and the whole system renders by its light."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from occfusion.observation.light import Light, observe_light
from occfusion.run import app
from occfusion.run.loaded import load_run
from occfusion.run.prepare import make_body, make_data, observe, observe_training_frames
from occfusion.settings.schema import load_settings
from occfusion.synth import SceneSpec, write_scene
from occfusion.synth.light import AMBIENT, KEY_DIRECTION
from occfusion.types import Frame

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
    folder = train(tmp_path, SPEC, "variant=A", "optim.key_light=false", "exposure=off")
    plan = {d["part"]: d for d in json.loads((folder / "plan.json").read_text())["decisions"]}
    assert not plan["key light"]["used"]
    run = load_run(folder)
    assert run.avatar.key_light is None
    body = make_body(run.settings.body)
    data = make_data(run.settings, body)
    data.setup()
    observed_frames = observe_training_frames(data, body)

    def read(position: int) -> Frame:
        return data.train_frame(position, truth=False)

    few = observe_light(read, observed_frames[:3], body.faces.numpy(), even=True)
    assert few == Light()  # three frames, none of which shows a point five times
    assert np.isfinite([m.vertices for m in observed_frames]).all()


@pytest.mark.slow
def test_pictures_of_a_camera_whose_exposure_wanders_are_evened(tmp_path: Path) -> None:
    """Each frame is too bright by a gain of its own; read again, it is as it was filmed under a steady exposure."""
    write_scene(tmp_path, SPEC, progress=False)
    gains = np.exp(0.1 * np.random.default_rng(0).normal(size=(SPEC.frames, 3)) - 0.2)
    for frame, gain in enumerate(gains):
        (file,) = (tmp_path / SPEC.name / "Camera_B1").glob(f"*{frame:06d}.jpg")
        picture = cv2.imread(str(file)).astype(np.float64) * gain[::-1]
        cv2.imwrite(
            str(file), np.clip(picture.round(), 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 98]
        )
    fixed = [
        "dataset=zju", f"dataset.root={tmp_path}", f"dataset.scene={SPEC.name}", "dataset.image_size=96",
        f"body.path={tmp_path / SPEC.name / 'body.npz'}", "optim.align_poses=false", "registration=off",
        "dataset.test_frames=[0,10,9]", "optim.unseen_colors=nearest",
    ]  # fmt: skip
    with initialize_config_dir(str(CONF), version_base="1.3"):
        even, off = (load_settings(compose("config", [*fixed, f"exposure={how}"])) for how in ("auto", "off"))
    found, as_filmed = observe(even), observe(off)
    assert found.light is not None and found.light.exposure is not None and found.light.gains is not None
    positions = found.data.train_indices
    true = np.log(gains[list(positions)])
    assert np.std(np.log(found.light.gains) - (true - true.mean(axis=0))) < 0.025
    assert found.data_hash != as_filmed.data_hash and found.held_out_hash == as_filmed.held_out_hash
    for position in (3, 20):
        own, raw = found.data.train_frame(position), as_filmed.data.train_frame(position)
        gain = torch.from_numpy(found.light.gains[position]).float()
        assert torch.allclose(own.rgb, (raw.rgb / gain).clamp_max(1.0), atol=1e-6)
        assert own.truth is not None and raw.truth is not None
        assert torch.allclose(own.truth.rgb, (raw.truth.rgb / gain).clamp_max(1.0), atol=1e-6)
        assert torch.equal(own.visible_mask, raw.visible_mask)
    held_out = found.data.test_views[0]
    assert torch.equal(found.data.test_frame(*held_out).rgb, as_filmed.data.test_frame(*held_out).rgb)
