"""What `render` refuses before a run is read, and files of cameras; an option never goes without effect unsaid."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from occfusion.__main__ import main
from occfusion.errors import ConfigError, DataError
from occfusion.run.showing import run_names
from occfusion.show.drawing import Layers
from occfusion.show.film import picture_of, side_by_side
from occfusion.show.views import read_views

CAMERA = {
    "viewmat": np.diag([1.0, -1.0, -1.0, 1.0]).tolist(), "K": [[80, 0, 32], [0, 90, 24], [0, 0, 1]],
    "width": 64, "height": 48,
}  # fmt: skip


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--path", "canonical", "--motion", "walk"], "the rest pose, which has no motion"),
        (["--moment", "3"], "--moment is for --path bullet-time"),
        (["--seconds", "1"], "nothing moves; add --motion sequence"),
        (["--path", "spiral", "--start", "1"], "nothing moves; add --motion sequence"),
        (["--start", "nan"], "--start nan"),
        (["--fps", "nan"], "--fps nan"),
        (["--frames", "0"], "--frames 0"),
        (["--layers", "rgb", "depth", "--output", "one.png"], "in one .png"),
    ],
)
def test_an_option_without_effect_is_refused(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["render", "nowhere", "--output", "film.mp4", *words]) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_part_of_what_moves_by_itself_is_no_mistake(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The run is what is missing then."""
    words = ["--path", "train", "--seconds", "1", "--output", str(tmp_path / "film.mp4")]
    assert main(["render", str(tmp_path / "nowhere"), *words]) == 1
    error = capsys.readouterr().err
    assert "nowhere" in error and "nothing moves" not in error


def test_cameras_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"cameras": [CAMERA]}))
    (own,) = read_views(path)
    # nerfstudio: camera to world, x right, y up, z back; this one stands 3 m before the origin on +z
    place = np.eye(4)
    place[2, 3] = 3.0
    row = {"transform_matrix": place.tolist()}
    said = {"w": 64, "h": 48, "fl_x": 80, "fl_y": 90, "cx": 32, "cy": 24, "frames": [row]}
    path.write_text(json.dumps(said))
    (theirs,) = read_views(path)
    torch.testing.assert_close(theirs.camera.K, own.camera.K)
    torch.testing.assert_close(theirs.camera.centre, torch.tensor([0.0, 0.0, 3.0]))
    # the origin is 3 m before it, in the middle; what is higher in the world is higher in the picture
    for point, seen in (((0, 0, 0), (0, 0, 3)), ((0, 1, 0), (0, -1, 3)), ((1, 0, 0), (1, 0, 3))):
        there = theirs.camera.viewmat @ torch.tensor([*point, 1.0])
        torch.testing.assert_close(there[:3], torch.tensor(seen).float())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 20000}, r"cameras\[1\].*8192"),
        ({"width": 0}, r"cameras\[1\].*8192"),
        ({"K": [[float("nan"), 0, 0], [0, 1, 0], [0, 0, 1]]}, r"cameras\[1\].*NaN"),
        ({"viewmat": np.diag([2.0, 1, 1, 1]).tolist()}, r"cameras\[1\].*rigid"),
        ({"viewmat": np.diag([-1.0, 1, 1, 1]).tolist()}, r"cameras\[1\].*mirrors"),
        ({"viewmat": [[1.0]]}, r"cameras\[1\].*shape"),
        ({"width": float("inf")}, r"cameras\[1\].*infinity"),
    ],
)
def test_a_camera_that_cannot_be_one_is_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"cameras": [CAMERA, {**CAMERA, **change}]}))
    with pytest.raises(DataError, match=message):
        read_views(path)


def test_a_field_of_view_of_nothing_is_named(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    row = {"transform_matrix": np.eye(4).tolist()}
    path.write_text(json.dumps({"w": 64, "h": 48, "camera_angle_x": 0.0, "frames": [row]}))
    with pytest.raises(DataError, match=r"cameras\[0\]: no camera"):
        read_views(path)


def test_a_file_without_cameras_says_what_belongs_there(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    path.write_text("{}")
    with pytest.raises(DataError) as caught:
        read_views(path)
    example = str(caught.value).split("give ")[1].split(", world to camera")[0]
    assert example.count("{") == example.count("}") and example.count("[") == example.count("]")


def test_transparent_pictures_have_straight_alpha_and_depth_is_millimetres() -> None:
    alpha = torch.tensor([[0.5, 0.0]])
    layers = Layers(
        torch.tensor([[[0.4, 0.2, 0.1], [0.0, 0.0, 0.0]]]), alpha, torch.tensor([[2.5, 0.0]]), None
    )
    rgba = picture_of(layers, "rgb", None, None)
    assert rgba[0, 0].tolist() == [204, 102, 51, 128] and rgba[0, 1, 3] == 0
    assert picture_of(layers, "depth", None, None).tolist() == [[2500, 0]]
    blue = torch.tensor([0.0, 0.0, 1.0])
    assert picture_of(layers, "rgb", blue, None)[0].tolist() == [[102, 51, 153], [0, 0, 255]]


def test_pictures_of_several_heights_are_refused() -> None:
    pictures = [np.zeros((40, 30, 3), np.uint8), np.zeros((50, 30, 3), np.uint8)]
    with pytest.raises(ConfigError, match="40, 50 pixels high"):
        side_by_side(pictures, [])


@pytest.mark.parametrize(
    ("folders", "names"),
    [
        (["/runs/a/E", "/runs/b/E"], ["a", "b"]),
        (["/runs/a/A", "/runs/b/E"], ["a/A", "b/E"]),
        (["/runs/a/E", "/runs/a/E"], ["E", "E"]),
        (["/runs/a", "/runs/a/E"], ["a", "a/E"]),
    ],
)
def test_names_of_runs_are_what_they_do_not_share(folders: list[str], names: list[str]) -> None:
    assert run_names([Path(folder) for folder in folders]) == names
