"""OcMotion as released: one sequence of many, read in bounded memory, and several people in a picture."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from data import layout_writers as writers
from occfusion.data.ocmotion import ocmotion_annotations
from occfusion.data.ocmotion.chomp_layout import ChompScene, sequence_names
from occfusion.errors import ConfigError, DataError
from occfusion.files import thinned, unpickle

K = np.array([[1500.0, 0, 960], [0, 1500, 540], [0, 0, 1]])


def person(value: float) -> dict:
    return {
        "pose": np.full(72, value),
        "betas": np.zeros(10),
        "trans": np.zeros(3),
        "intri": K,
        "extri": np.eye(4),
    }


def cameras(pattern: str, number: int, frames: int = 3) -> list[list[dict]]:
    return [
        [{"h_w": (1080, 1920), "img_path": pattern.format(camera=c, frame=f), "4": person(number + f / 10)}
         for f in range(frames)]
        for c in range(2)
    ]  # fmt: skip


def sequence(name: str, number: int) -> list[list[dict]]:
    return cameras(f"images/{name}/Camera{{camera:02d}}/{{frame:05d}}.jpg", number)


def opened(folder: Path, name: str) -> ChompScene:
    return ChompScene(folder, name, lambda betas: np.zeros(3))


@pytest.fixture
def folder(tmp_path) -> Path:
    writers.save_pickle(tmp_path / "annot" / "train.pkl", [sequence("0001", 1), sequence("0002", 2)])
    writers.save_pickle(tmp_path / "annot" / "test.pkl", [sequence("0003", 3)])
    return tmp_path


def test_annotations_without_a_sequence_are_not_called_missing(tmp_path):
    writers.save_pickle(tmp_path / "annot" / "train.pkl", [])
    with pytest.raises(DataError, match="holds no sequence in its annotations"):
        opened(tmp_path, "0001")
    (tmp_path / "annot" / "train.pkl").unlink()
    with pytest.raises(DataError, match=r"holds neither train\.pkl nor test\.pkl"):
        opened(tmp_path, "0001")


def test_each_sequence_has_its_own_poses(folder):
    assert sequence_names(folder) == ["0001", "0002", "0003"]
    for number in (1, 2, 3):
        scene = opened(folder, f"000{number}")
        assert scene.num_frames == 3
        assert scene.cameras == tuple(f"images/000{number}/Camera0{c}" for c in range(2))
        for frame in range(3):
            np.testing.assert_allclose(scene.parameters(frame).body_pose, number + frame / 10)
    with pytest.raises(ConfigError, match=r"'0009': the annotations in .* have 0001, 0002, 0003"):
        opened(folder, "0009")


def test_only_the_wanted_sequence_is_kept_while_reading(folder, monkeypatch):
    kept: list[object] = []

    def watched(path, thin):
        content = thinned.load_thinned(path, thin)
        kept.extend(frame for cams in content for frames in cams for frame in frames if "4" in frame)
        return content

    monkeypatch.setattr(ocmotion_annotations, "load_thinned", watched)
    monkeypatch.setattr(ocmotion_annotations, "load_pickle", lambda path: pytest.fail("read as a whole"))
    opened(folder, "0002")
    assert {frame["img_path"].split("/")[1] for frame in kept} == {"0002"} and len(kept) == 6
    kept.clear()
    assert len(sequence_names(folder)) == 3 and not kept


def test_sequences_whose_pictures_name_none_are_numbered(tmp_path):
    content = [sequence("0001", 1), cameras("{camera}/{frame:05d}.jpg", 5)]
    writers.save_pickle(tmp_path / "annot" / "train.pkl", content)
    assert sequence_names(tmp_path) == ["0001", "train/1"]
    np.testing.assert_allclose(opened(tmp_path, "train/1").parameters(0).body_pose, 5.0)


def test_pictures_of_one_sequence_in_folders_of_several_names(tmp_path):
    """The name is that of the first camera's folder; then the other camera's frames must not be lost."""
    odd = sequence("0002", 2)
    for frame in odd[1]:
        frame["img_path"] = frame["img_path"].replace("0002", "0002b")
    writers.save_pickle(tmp_path / "annot" / "train.pkl", [sequence("0001", 1), odd])
    scene = opened(tmp_path, "0002")
    assert scene.num_frames == 3 and scene.files(1, 1).rgb.as_posix().endswith("0002b/Camera01/00001.jpg")


def test_the_file_may_be_larger_than_what_is_read_into_memory(folder, monkeypatch):
    monkeypatch.setattr(unpickle, "MAX_PICKLE_BYTES", 100)
    assert opened(folder, "0002").num_frames == 3
    assert len(pickle.dumps(sequence("0002", 2))) > 100
