"""`occfusion check` on sound and on broken folders: what it says, its picture, its exit code."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from data import layout_writers as writers
from data.layout_writers import Source
from occfusion.__main__ import main
from occfusion.data.body_convention import rotation_matrix
from occfusion.data.checking.fit import inspect_fit
from occfusion.data.checking.inspection import (
    Finding,
    Inspection,
    guarded,
    inspect_bodies,
    inspect_cameras,
    inspect_masks,
    listed,
    worst,
)
from occfusion.data.checking.overlap import CAMERA_ERRORS
from occfusion.data.opening import open_folder
from occfusion.data.posing import Poser
from occfusion.errors import DataError
from occfusion.synth import SceneSpec, write_scene

SPEC = SceneSpec(1, "clean", image_size=96, frames=4, cameras=2)


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    return write_scene(tmp_path_factory.mktemp("sound"), SPEC, progress=False)


@pytest.fixture(autouse=True)
def wide(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "400")


@pytest.fixture
def scene(sound, tmp_path) -> Source:
    return Source(Path(shutil.copytree(sound, tmp_path / "data" / "001-clean")))


def check(capsys, *arguments: object) -> tuple[int, str]:
    code = main(["check", *map(str, arguments)])
    return code, capsys.readouterr().out


def change_cameras(scene: Source, key: str, change) -> None:
    scene.cams[key] = [change(np.array(value)) for value in scene.cams[key]]
    writers.save_object(scene.folder / "annots.npy", scene.annots)


def test_a_folder_with_brackets_keeps_its_name(capsys, tmp_path):
    code, said = check(capsys, tmp_path / "clip [final]")
    first, *_, last = said.splitlines()
    assert code == 1 and first.strip().endswith("clip [final]")
    assert last.endswith("clip [final]: training would not start")


def test_a_sound_folder(scene, capsys, tmp_path):
    code, said = check(capsys, scene.folder)
    assert code == 0 and "ready to train" in said and "doubt" not in said and "error" not in said
    assert "original: 4 frames, 2 cameras" in said and "det R 1.0" in said
    picture = cv2.imread(str(tmp_path / "check_001-clean.png"))
    assert picture.shape == (480, 4 * 480, 3)
    assert "of the body's surface is seen from many directions" in said
    directions = cv2.imread(str(tmp_path / "check_001-clean_directions.png"))
    assert directions.shape[0] == 480
    colours = {tuple(colour) for colour in picture.reshape(-1, 3).tolist()}
    assert {(60, 220, 40), (40, 60, 240), (40, 230, 255)} <= colours  # mask, body and joints, as BGR


@pytest.mark.parametrize(
    "write",
    [
        writers.write_refined,
        writers.write_stamped,
        writers.write_w2a,
        writers.write_video,
        writers.write_humannerf,
    ],
)
def test_a_folder_of_other_layouts(write, scene, capsys, tmp_path):
    target = tmp_path / "other"
    named = write in (writers.write_video, writers.write_humannerf)
    folder = write(scene, target / "mine" if named else target)
    code, said = check(capsys, target, "--body", scene.folder / "body.npz", "--strict")
    assert code == 0, said
    assert str(folder) in said and "hidden share by frame" in said


def test_the_raw_release(scene, capsys, tmp_path):
    folder, body = writers.write_chomp(scene, tmp_path / "raw"), ("--body", scene.folder / "body.npz")
    code, said = check(capsys, folder, *body)
    assert code == 1 and "name one (--scene here, dataset.scene in training) of 0001_01, 0013_02" in said
    code, said = check(capsys, folder, *body, "--scene", "0013_02", "--strict")
    assert code == 2 and "the people 7 are annotated beside person 1" in said and "--numbered-masks" in said
    code, said = check(
        capsys, folder, *body, "--scene", "0013_02", "--person", 1, "--numbered-masks", "--strict"
    )
    assert code == 0 and "chomp: 4 frames, 2 cameras" in said, said


def test_other_people_are_seen(scene, capsys, tmp_path):
    folder = writers.write_video(scene, tmp_path / "mine")
    path = sorted((folder / "masks").iterdir())[1]
    numbers = scene.mask(1) * np.uint8(255)
    numbers[numbers.shape[0] // 2 :][numbers[numbers.shape[0] // 2 :] > 0] = 9
    cv2.imwrite(str(path), numbers)
    code, said = check(capsys, folder, "--body", scene.folder / "body.npz", "--person", 255)
    shares = re.search(r"estimated from the projected body\): 0: (\d+)%, 1: (\d+)%", said)
    assert code == 0 and int(shares[1]) < 15 and int(shares[2]) > 25, said


def test_without_a_body_file_it_is_said_that_the_fit_is_rough(scene, capsys):
    (scene.folder / "body.npz").unlink()
    code, said = check(capsys, scene.folder)
    assert code == 0 and "the embedded body stands in" in said and "--body SMPL_NEUTRAL.pkl" in said


def test_several_errors_are_all_said_at_once(scene, capsys):
    (scene.folder / "mask" / scene.path(2, 1)).with_suffix(".png").unlink()
    writers.save_object(
        scene.folder / "new_params" / "3.npy", dict(scene.parameters(3), Th=np.full((1, 3), np.nan))
    )
    change_cameras(scene, "R", lambda R: R * [[1], [-1], [1]])
    code, said = check(capsys, scene.folder)
    assert code == 1 and "training would not start" in said
    for words in ("1 files of 8 views are missing", "bad frames", "NaN", "det = -1", "Camera_B1"):
        assert words in said, said


def test_exchanged_cameras_are_named(scene, capsys):
    rotations = scene.cams["R"]
    rotations[0], rotations[1] = rotations[1], rotations[0]
    writers.save_object(scene.folder / "annots.npy", scene.annots)
    code, said = check(capsys, scene.folder)
    assert code == 1 and "of cameras Camera_B1 and Camera_B13 are exchanged" in said
    assert "body and mask fit in all" not in said and "overlap badly" not in said


def test_doubts_matter_when_strict(scene, capsys):
    shutil.rmtree(scene.folder / "new_vertices")  # these would tell that the parameters are not theirs
    for frame in range(4):
        moved = scene.parameters(frame)
        writers.save_object(
            scene.folder / "new_params" / f"{frame}.npy", dict(moved, Th=moved["Th"] + [[0.18, 0.0, 0.0]])
        )
    assert check(capsys, scene.folder)[0] == 0
    code, said = check(capsys, scene.folder, "--strict")
    assert code == 2 and "look at the doubts first" in said and "IoU" in said


def test_a_folder_of_nothing_known(tmp_path, capsys):
    code, said = check(capsys, tmp_path)
    assert code == 1 and "no layout that is known here" in said


def test_code_in_a_file_is_reported_and_not_run(scene, capsys, tmp_path):
    import os

    class Runs:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'ran'}",)

    writers.save_object(scene.folder / "annots.npy", {"cams": Runs(), "ims": []})
    code, said = check(capsys, scene.folder)
    assert code == 1 and "not allowed" in said and not (tmp_path / "ran").exists()


def inspected(scene: Source) -> Inspection:
    poser = Poser(scene.body)
    inspection = Inspection(open_folder(scene.folder, poser)[1], poser)
    for part in (inspect_cameras, inspect_bodies, inspect_masks):
        part(inspection)
    return inspection


def broken(name: str, R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A right camera written down with a known mistake, in metres."""
    return {
        "R is transposed (camera to world)": (R.T, t),
        "R and T are the camera's place, not world to camera": (R.T, -R.T @ t),
        "T is the camera's centre": (R, -R.T @ t),
        "T is 1000 times too large (millimetres)": (R, 1000 * t),
        "T is 1000 times too small (metres read as millimetres)": (R, t / 1000),
        "camera axes are OpenGL's (y up, z backward)": (
            np.diag([1.0, -1, -1]) @ R,
            np.diag([1.0, -1, -1]) @ t,
        ),
    }[name]


@pytest.mark.parametrize("name", sorted(CAMERA_ERRORS))
def test_known_mistakes_of_cameras_are_named(name, scene):
    inspection = inspected(scene)
    from dataclasses import replace

    right = inspection.sound[0]
    R, t = broken(name, right.R, right.t)
    inspection.sound[0] = replace(right, R=R, t=t)
    found = {finding.topic: finding for finding in inspect_fit(inspection)}
    assert found["fit"].level in ("doubt", "error") and name in found["fit"].cure, found["fit"]


def test_frames_that_jump_are_named(scene):
    moved = scene.parameters(2)
    turned = rotation_matrix(moved["Rh"][0].astype(float)) @ rotation_matrix(np.array([0.0, 0.0, 2.0]))
    writers.save_object(
        scene.folder / "new_params" / "2.npy", dict(moved, Rh=cv2.Rodrigues(turned)[0].reshape(1, 3))
    )
    inspection = inspected(scene)
    motion = [finding for finding in inspect_bodies(inspection) if finding.topic == "motion"]
    assert len(motion) == 1 and "2 frames jump or turn sharply" in motion[0].text and "2, 3" in motion[0].text


def test_settings(scene, capsys):
    assert main(["check", str(scene.folder), "--camera", "5"]) == 1
    assert "the scene has the cameras 0..1" in capsys.readouterr().err


def test_words():
    assert listed(range(10), 3) == "0, 1, 2 and 7 more" and listed([1]) == "1"
    assert worst([]) == "ok" and worst([Finding("doubt", "a", "b"), Finding("note", "a", "b")]) == "doubt"

    def fails():
        yield Finding("ok", "a", "first")
        raise DataError("second")

    assert [finding.text for finding in guarded("a", fails)] == ["first", "second"]


def test_who_does_not_turn_is_told_without_a_doubt(tmp_path, capsys):
    spec = SceneSpec(3, "clean", image_size=96, frames=8, cameras=1, turn=20)
    folder = write_scene(tmp_path / "scenes", spec, progress=False)
    code, said = check(capsys, folder, "--strict", "--overlay", tmp_path / "look.png")
    assert code == 0 and "doubt" not in said
    assert "nobody sees the back" in said and "will be a guess" in said
    assert (tmp_path / "look_directions.png").is_file()
