"""`fit` and `import` from files alone: key points, masks and a camera in, poses, figures and an overlay out."""

from __future__ import annotations

import argparse
import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from occfusion.__main__ import main
from occfusion.cli.import_clip import height_source
from occfusion.files.atomic import write_png
from occfusion.files.jsonfile import load_json
from occfusion.fitting.anchors import landmark_places
from occfusion.fitting.batch import BodyBatch, rotations_of
from occfusion.fitting.quality import silhouette
from occfusion.footage.landmarks import INDEX
from occfusion.human import embedded_body
from occfusion.importing.keypoints import COCO
from occfusion.run import app
from occfusion.synth.motion import make_take

CONF = Path(__file__).parents[2] / "conf"
FRAMES, WIDTH, HEIGHT, FOCAL = 8, 96, 128, 150.0


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """Returns a folder as other tools leave it, `coco.json` beside it, and the true joints."""
    folder = tmp_path_factory.mktemp("given")
    take = make_take(60, np.zeros(10), False, np.random.default_rng(3), turn=40.0)
    poses = torch.tensor(take.poses[:FRAMES], dtype=torch.float32)
    body = embedded_body()
    batch = BodyBatch(body, np.arange(len(body.v_template)))
    rotations = rotations_of(poses[:, :3], poses[:, 3:])
    rotations[:, 0] = torch.diag(torch.tensor([1.0, -1.0, -1.0])) @ rotations[:, 0]
    betas, transl = torch.zeros(10), torch.tensor([[0.0, 0.0, 3.0]]).repeat(FRAMES, 1)
    turns, places = batch.transforms(betas, rotations, transl)
    vertices = batch.points(betas, turns, places).double().numpy()
    marks = landmark_places(turns, places).double().numpy()
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    pixels = marks[..., :2] / marks[..., 2:] * FOCAL + K[:2, 2] - 0.5
    rows = [
        {
            "image_id": f"{k:06d}.png",
            "keypoints": [v for name in COCO for v in (*pixels[k, INDEX[name]], 0.9)],
        }
        for k in range(FRAMES)
    ]
    (folder / "coco.json").write_text(json.dumps(rows))
    for k in range(FRAMES):
        shown = silhouette(vertices[k], K, body.faces.numpy(), (HEIGHT, WIDTH))
        write_png(
            folder / "clip" / "images" / f"{k:06d}.png", np.repeat(np.uint8(200) * shown[..., None], 3, 2)
        )
        write_png(folder / "clip" / "masks" / f"{k:06d}.png", shown)
    np.savez(folder / "clip" / "cameras.npz", intrinsic=K, extrinsic=np.eye(4), width=WIDTH, height=HEIGHT)
    return folder, places.double().numpy()


@pytest.mark.slow
def test_a_folder_without_bodies_gets_them(given, monkeypatch, capsys):
    folder, truth = given
    monkeypatch.setitem(__import__("sys").modules, "ai_edge_litert", None)  # nothing has to be looked for
    words = ["fit", str(folder / "clip"), "--keypoints", str(folder / "coco.json")]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "verdict            trusted" in out and "m, a guess" in out
    report = load_json(folder / "clip" / "fit.json")
    assert report["median_mask_iou"] > 0.85 and report["median_reprojection_percent_of_height"] < 1.0
    assert report["doubtful_frames"] == [] and (folder / "clip" / "overlay.mp4").stat().st_size > 1000
    found = np.load(folder / "clip" / "poses.npz")
    body = embedded_body()
    for k in range(FRAMES):
        rows = (found["betas"], *(found[key][k] for key in ("global_orient", "body_pose", "transl")))
        _, joints = body(*(torch.tensor(row, dtype=torch.float32) for row in rows))
        a, b = joints.numpy() - joints.numpy()[0], truth[k] - truth[k, 0]
        assert np.linalg.norm(a - b, axis=1).mean() < 0.09
    monkeypatch.chdir(folder)  # pictures are put where the command is given
    assert main(["check", str(folder / "clip"), "--layout", "video"]) == 0


def test_poses_that_are_not_of_a_fit_are_left_alone(given, tmp_path, capsys):
    folder, _ = given
    (tmp_path / "poses.npz").write_bytes(b"mine")
    words = ["fit", "--keypoints", str(folder / "coco.json"), "--masks", str(folder / "clip" / "masks")]
    assert main([*words, "--output", str(tmp_path)]) == 1
    assert "is there already" in capsys.readouterr().err
    assert main(words) == 1
    assert "--output" in capsys.readouterr().err


@pytest.mark.slow
def test_a_person_is_as_tall_as_was_said(given, tmp_path, capsys):
    folder, _ = given
    words = ["fit", str(folder / "clip"), "--keypoints", str(folder / "coco.json"), "--output", str(tmp_path)]
    assert main([*words, "--height", "1.6"]) == 0
    assert " m, as given" in capsys.readouterr().out
    report = load_json(tmp_path / "fit.json")
    assert report["height_source"] == "as given" and abs(report["height_metres"] - 1.6) < 0.02
    assert report["median_mask_iou"] > 0.85


def test_a_height_that_no_person_has_or_that_is_known_already_is_refused(given, tmp_path, capsys):
    folder, _ = given
    images, output = str(folder / "clip" / "images"), ["--output", str(tmp_path / "out")]
    assert main(["import", images, *output, "--height", "175"]) == 1
    assert "metres, 0.5 to 2.5" in capsys.readouterr().err
    np.savez(tmp_path / "poses.npz", betas=np.zeros(10))
    assert main(["import", images, *output, "--from", str(tmp_path / "poses.npz"), "--height", "1.7"]) == 1
    assert "has a height already" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_height_is_said_to_be_of_whom_it_is():
    given, guessed = argparse.Namespace(height=1.7), argparse.Namespace(height=None)
    assert height_source(given, is_own=True) == "as given"
    assert "--height" in height_source(guessed, is_own=True)
    assert "--height" not in height_source(guessed, is_own=False)  # a body of another tool


@pytest.mark.slow
def test_an_import_from_files_alone_is_mended_and_can_be_trained_on(given, tmp_path, monkeypatch, capsys):
    folder, _ = given
    monkeypatch.setitem(__import__("sys").modules, "ai_edge_litert", None)
    words = [
        "import", str(folder / "clip" / "images"), "--keypoints", str(folder / "coco.json"),
        "--masks", str(folder / "clip" / "masks"), "--camera", str(folder / "clip" / "cameras.npz"),
    ]  # fmt: skip
    assert main([*words, "--output", str(tmp_path / "plain"), "--mending", "off"]) == 0
    assert "colours  " not in capsys.readouterr().out
    assert main([*words, "--output", str(tmp_path / "mended")]) == 0
    out = capsys.readouterr().out
    assert "colours  " in out and "Lightning" not in out and "plan" not in out
    plain, mended = (load_json(tmp_path / name / "import.json") for name in ("plain", "mended"))
    assert "mended_by_colour" not in plain and mended["trusted"]
    assert mended["median_mask_iou"] > plain["median_mask_iou"] - 0.01
    is_moved = not np.array_equal(
        *(np.load(tmp_path / name / "poses.npz")["transl"] for name in ("plain", "mended"))
    )
    assert mended["mended_by_colour"]["taken"] == is_moved
    assert {path.name for path in tmp_path.iterdir()} == {"plain", "mended"}  # no run folder is left

    printed = shlex.split(out[out.index("python train.py") :].replace("\\\n", " "))[2:]
    overrides = [*printed, "trainer.fast_dev_run=true", f"output_dir={tmp_path / 'run'}"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        app.run(compose("config", overrides), folder_chosen_by_user=True)
