"""A scene on disk: the layout, that it is whole or absent, and that it is the same each time."""

from __future__ import annotations

import errno
import hashlib
import json
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from occfusion.__main__ import main
from occfusion.errors import DataError
from occfusion.files.arrays import load_npy
from occfusion.files.images import image_size, read_mask, read_rgb
from occfusion.synth import SceneSpec, write_scene, writer
from occfusion.synth import manifest as manifest_module

TINY = replace(SceneSpec.parse("001-hard-boxes"), image_size=48, frames=2, cameras=2)


def _hashes(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scenes"), TINY, progress=False)


def test_layout_is_zju_mocap_s(written: Path) -> None:
    annots = load_npy(written / "annots.npy")
    assert sorted(annots) == ["cams", "ims"]
    cams = annots["cams"]
    assert {k: len(v) for k, v in cams.items()} == {"K": 2, "R": 2, "T": 2, "D": 2}
    shapes = {k: np.asarray(v[0]).shape for k, v in cams.items()}
    assert shapes == {"K": (3, 3), "R": (3, 3), "T": (3, 1), "D": (5, 1)}
    assert 2000 < np.linalg.norm(cams["T"][0]) < 4000  # millimetres
    assert len(annots["ims"]) == 2
    for moment in annots["ims"]:
        for name in moment["ims"]:
            assert image_size(written / name) == (48, 48)
            for tree in ("mask", "mask_complete"):
                mask = read_mask(written / tree / Path(name).with_suffix(".png"))
                assert mask.shape == (48, 48) and mask.any()
            assert read_rgb(written / "images_complete" / name).shape == (48, 48, 3)
    for frame in range(2):
        parameters = load_npy(written / "new_params" / f"{frame}.npy")
        have = {k: np.asarray(v).shape for k, v in parameters.items()}
        assert have == {"poses": (1, 72), "Rh": (1, 3), "Th": (1, 3), "shapes": (1, 10)}
        assert load_npy(written / "new_vertices" / f"{frame}.npy").shape == (6890, 3)
    assert (written / "body.npz").is_file()


def test_the_same_spec_gives_the_same_bytes(written: Path, tmp_path: Path) -> None:
    again = write_scene(tmp_path, TINY, progress=False)
    assert _hashes(again) == _hashes(written)
    other = write_scene(tmp_path / "other", replace(TINY, seed=1), progress=False)
    assert _hashes(other)["Camera_B1/000000.jpg"] != _hashes(written)["Camera_B1/000000.jpg"]


def test_a_finished_scene_is_not_written_again(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("written again")

    monkeypatch.setattr(writer, "_write_all", fail)
    assert write_scene(written.parent, TINY, progress=False) == written


def test_a_scene_of_an_older_generator_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifest_module, "VERSION", 0)
    folder = write_scene(tmp_path, TINY, progress=False)
    monkeypatch.undo()
    (folder / "stray").touch()
    assert write_scene(tmp_path, TINY, progress=False) == folder
    assert not (folder / "stray").exists()
    assert json.loads((folder / "scene.json").read_text())["version"] == manifest_module.VERSION
    assert [p.name for p in tmp_path.iterdir()] == [folder.name]


def test_other_settings_are_refused_by_name(written: Path) -> None:
    before = _hashes(written)
    with pytest.raises(DataError, match=r"image_size 48 \(wanted 64\)"):
        write_scene(written.parent, replace(TINY, image_size=64), progress=False)
    assert _hashes(written) == before


@pytest.mark.parametrize("content", [{"photo.jpg": "x"}, {"scene.json": "{"}, {"scene.json": "[]"}])
def test_a_foreign_folder_is_left_alone(tmp_path: Path, content: dict[str, str]) -> None:
    folder = tmp_path / TINY.name
    folder.mkdir()
    for name, text in content.items():
        (folder / name).write_text(text)
    with pytest.raises(DataError, match=TINY.name):
        write_scene(tmp_path, TINY, progress=False)
    assert {p.name: p.read_text() for p in folder.iterdir()} == content


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / TINY.name).write_text("x")
    with pytest.raises(DataError, match="is a file"):
        write_scene(tmp_path, TINY, progress=False)


@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_nothing_is_left_when_writing_ends_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException
) -> None:
    def fail(*_: object) -> None:
        raise failure

    monkeypatch.setattr(writer, "_write_shot", fail)
    with pytest.raises((DataError, KeyboardInterrupt)) as caught:
        write_scene(tmp_path, TINY, progress=False)
    if caught.type is DataError:
        assert "disk is full" in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_too_little_space_is_noticed_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = writer.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(writer.shutil, "disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(DataError, match="MB are free"):
        write_scene(tmp_path, TINY, progress=False)
    assert list(tmp_path.iterdir()) == []


def test_leftovers_of_a_killed_process_are_removed(tmp_path: Path) -> None:
    left = tmp_path / f".{TINY.name}.4194305.abc.partial"  # above the largest process id
    left.mkdir()
    write_scene(tmp_path, TINY, progress=False)
    assert not left.exists()


def test_runs_that_need_the_same_scene_at_once_write_it_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    original = writer._write_all

    def slowly(folder: Path, *rest: Any) -> None:
        made.append(folder)
        time.sleep(0.5)
        original(folder, *rest)

    monkeypatch.setattr(writer, "_write_all", slowly)
    threads = [
        threading.Thread(target=write_scene, args=(tmp_path, TINY), kwargs={"progress": False}) for _ in "ab"
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert len(made) == 1
    assert [path.name for path in tmp_path.iterdir()] == [TINY.name]


BLENDED = 0.2
"""Degrees that the pelvis sways where one movement is blended into the next."""


def _yaw(folder: Path) -> np.ndarray:
    """Where the body of each frame on disk faces, degrees; 0: the world's -y, where the first camera stands."""
    found = []
    for k in range(len(list((folder / "new_params").iterdir()))):
        params = load_npy(folder / "new_params" / f"{k}.npy")
        turn, _ = cv2.Rodrigues(np.asarray(params["Rh"], np.float64).reshape(3))
        side = turn @ [1.0, 0.0, 0.0]  # the body's left: level however far it bends
        found.append(np.degrees(np.arctan2(side[1], side[0])))
    return np.asarray(found)


@pytest.mark.parametrize(
    ("words", "sweep", "middle"), [("front", 30, 0), ("back", 30, 180), ("side-sit", 30, 90), ("turn0", 0, 0)]
)
def test_who_does_not_turn_stays_within_the_sweep(
    tmp_path: Path, words: str, sweep: float, middle: float
) -> None:
    spec = replace(SceneSpec.parse(f"103-clean-{words}"), image_size=16, frames=60, cameras=1)
    yaw = (_yaw(write_scene(tmp_path, spec, progress=False)) - middle + 180.0) % 360.0 - 180.0
    assert np.abs(yaw).max() <= 0.5 * sweep + BLENDED
    assert np.ptp(yaw) == pytest.approx(sweep, abs=0.02 * sweep + BLENDED)


def test_without_such_a_word_people_turn_all_round(tmp_path: Path) -> None:
    spec = replace(SceneSpec.parse("103-clean"), image_size=16, frames=100, cameras=1)
    yaw = _yaw(write_scene(tmp_path, spec, progress=False))
    assert set((yaw % 360 // 30).astype(int)) == set(range(12))


def test_a_short_scene_is_the_beginning_of_a_long_one(tmp_path: Path) -> None:
    long, short = (
        write_scene(tmp_path, replace(SceneSpec.parse(name), image_size=16, cameras=1), progress=False)
        for name in ("002-clean-front", "002-clean-front-short10")
    )
    files = {k: v for k, v in _hashes(long).items() if k.endswith(".npy") and k.startswith("new_")}
    beginning = {k: v for k, v in _hashes(short).items() if k.endswith(".npy") and k.startswith("new_")}
    assert len(beginning) == 20
    assert beginning.items() <= files.items()


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "synth",
        str(tmp_path),
        "--scene",
        "100-clean",
        "--size",
        "32",
        "--frames",
        "1",
        "--cameras",
        "1",
    ]
    assert main([*command, "--quiet"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "100-clean")
    assert main(["synth", str(tmp_path), "--scene", "100-nice"]) == 1
    assert "level='nice'" in capsys.readouterr().err
    assert main(["synth", str(tmp_path), "--size", "2048"]) == 1
    assert "1024" in capsys.readouterr().err
