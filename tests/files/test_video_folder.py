"""Folders of numbered pictures: all of them or none, and none of an earlier film."""

from __future__ import annotations

import numpy as np
import pytest

from occfusion.errors import DataError
from occfusion.files import video
from occfusion.files.images import read_rgb
from occfusion.files.video import write_folder, write_frames


def grey(level):
    return np.full((4, 5, 3), level, np.uint8)


def names(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_layers_of_a_shorter_film_take_the_place_of_a_longer_one(tmp_path):
    out = tmp_path / "out"
    assert write_folder(out, ([grey(k), grey(100 + k)] for k in range(3)), ["rgb", "alpha"]) == 3
    (out / "rgb" / "note.txt").write_text("mine")
    (out / "rgb" / "cover.png").write_bytes(b"mine")
    assert write_folder(out, ([grey(9 + k), grey(109 + k)] for k in range(2)), ["rgb", "alpha"]) == 2
    assert names(out) == [
        "alpha/0000.png", "alpha/0001.png", "rgb/0000.png", "rgb/0001.png", "rgb/cover.png", "rgb/note.txt",
    ]  # fmt: skip
    assert (
        read_rgb(out / "rgb" / "0001.png").max() == 10 and read_rgb(out / "alpha" / "0000.png").max() == 109
    )
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_what_stops_half_way_leaves_the_folder_as_it_was(tmp_path):
    out = tmp_path / "out"
    write_frames(out, [grey(1), grey(2)], 24)

    def interrupted():
        yield [grey(7)]
        raise DataError("a picture that cannot be drawn")

    with pytest.raises(DataError, match="cannot be drawn"):
        write_folder(out, interrupted(), [""])
    assert names(out) == ["0000.png", "0001.png"] and read_rgb(out / "0000.png").max() == 1
    with pytest.raises(DataError):
        write_folder(tmp_path / "new", interrupted(), [""])
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("name", ["a.mp4", "a.avi"])
def test_a_codec_that_is_not_there_is_one_message_and_no_file(tmp_path, monkeypatch, name):
    monkeypatch.setattr(video, "CODECS", dict.fromkeys(video.CODECS, "ZZZZ"))
    with pytest.raises(DataError, match=r"no codec ZZZZ for 16 x 16 pixels; write \.webp"):
        write_frames(tmp_path / name, [np.zeros((16, 16, 3), np.uint8)], 10)
    assert not list(tmp_path.iterdir())
