"""`render` as a user types it, on a run of a few steps."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from occfusion.__main__ import main
from occfusion.evaluation.pictures import to_uint8
from occfusion.human.rendering import Renderer
from occfusion.run.bodies import make_body, make_data
from occfusion.run.loaded import load_run


def render(*words: str) -> int:
    return main(["render", *words])


@pytest.fixture
def run(short_run: Path) -> Path:
    return short_run


def test_paths_motions_layers_and_formats(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    # held-out views at their own size are the evaluation's pictures
    assert render(str(run), "--path", "held-out", "--frames", "2", "--output", str(out)) == 0
    loaded = load_run(run)
    data = make_data(loaded.settings, make_body(loaded.settings.body))
    data.setup()
    frame = data.test_frame(*data.test_views[0])
    truth = to_uint8(Renderer("auto").frame(loaded.avatar, frame).rgb)
    ours = cv2.imread(str(out / "0000.png"))[..., ::-1]
    assert np.abs(ours.astype(int) - truth).max() <= 1
    # odd sizes, alpha, depth in millimetres, another motion, another lamp
    words = ["--layers", "rgb", "depth", "normals", "--size", "65x49", "--frames", "2", "--motion", "squat"]
    layers = tmp_path / "layers"
    lamp = ["--background", "transparent", "--light", "90,20"]
    assert render(str(run), *words, *lamp, "--output", str(layers)) == 0
    rgba = cv2.imread(str(layers / "rgb" / "0001.png"), cv2.IMREAD_UNCHANGED)
    depth = cv2.imread(str(layers / "depth" / "0001.png"), cv2.IMREAD_UNCHANGED)
    assert rgba.shape == (49, 65, 4) and depth.dtype == np.uint16
    assert depth[rgba[..., 3] > 200].min() > 1000 and not depth[rgba[..., 3] == 0].any()
    both = tmp_path / "both.webp"
    assert render(str(run), str(run), "--frames", "2", "--size", "48", "--output", str(both)) == 0
    found, animation = cv2.imreadanimation(str(both))  # OpenCV reads what Pillow has written
    assert found and len(animation.frames) == 2 and animation.frames[0].shape[1] == 2 * 48
    assert np.ptp(animation.frames[0][..., :3]) > 60
    film = tmp_path / "film.mp4"
    assert render(str(run), "--path", "train", "--frames", "3", "--size", "64", "--output", str(film)) == 0
    assert cv2.VideoCapture(str(film)).get(cv2.CAP_PROP_FRAME_COUNT) == 3


def test_one_background_is_asked_for(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / "film.mp4"
    with pytest.raises(SystemExit, match="2"):
        main(["render", str(run), "--output", str(film), "--white", "--background", "grey"])
    assert "not allowed with argument" in capsys.readouterr().err
    assert not film.exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--size", "0"], "--size 0"),
        (["--size", "20000"], "--size 20000"),
        (["--motion", "squatt"], "--motion squatt"),
        (["--path", "nowhere.json"], "there is no such file"),
        (["--background", "#12"], "six hexadecimal digits"),
        (["--light", "bright"], "AZIMUTH,HEIGHT"),
        (["--background", "transparent"], "no transparency"),
        (["--motion", "other.npz"], "SMPL's skeleton"),
        (["--motion", "nan.npz"], "row 2, body_pose holds NaN"),
        (["--path", "inside.json"], "within the body"),
    ],
)
def test_bad_input_is_one_message_and_writes_nothing(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    words: list[str], message: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    np.savez("other.npz", joints=np.zeros((4, 17, 3)))
    poses = np.zeros((4, 72))
    poses[2, 5] = np.nan
    np.savez("nan.npz", poses=poses, trans=np.zeros((4, 3)))
    if words[-1] == "inside.json":
        transl = torch.tensor(load_run(run).clip.transl[0])
        viewmat = torch.eye(4)
        viewmat[:3, 3] = -transl
        row = {
            "viewmat": viewmat.tolist(),
            "K": [[50, 0, 32], [0, 50, 32], [0, 0, 1]],
            "width": 64,
            "height": 64,
        }
        import json

        Path("inside.json").write_text(json.dumps({"cameras": [row]}))
    assert render(str(run), "--output", "film.mp4", *words) == 1
    assert message in capsys.readouterr().err
    assert not Path("film.mp4").exists()


def test_one_picture_is_not_many(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert render(str(run), "--frames", "3", "--size", "32", "--output", str(tmp_path / "a.png")) == 1
    assert "add --frames 1" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
