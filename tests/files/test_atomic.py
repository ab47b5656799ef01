"""Files appear whole or not at all."""

from __future__ import annotations

import errno
import json
import os

import numpy as np
import pytest

from occfusion.errors import DataError
from occfusion.files.atomic import atomic_write, write_bytes, write_json, write_png
from occfusion.files.images import read_rgb


def test_content_and_rights(tmp_path):
    write_bytes(tmp_path / "new folder" / "ä.bin", b"abc")
    path = tmp_path / "new folder" / "ä.bin"
    assert path.read_bytes() == b"abc"
    plain = tmp_path / "plain"
    plain.write_bytes(b"")
    assert path.stat().st_mode == plain.stat().st_mode


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path, error):
    write_bytes(tmp_path / "a", b"old")

    def write_and_fail():
        with atomic_write(tmp_path / "a") as stream:
            stream.write(b"half of the n")
            raise error

    with pytest.raises(error):
        write_and_fail()
    assert (tmp_path / "a").read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a"]


@pytest.mark.parametrize("broken", ["fsync", "replace"])
def test_a_full_disk_is_a_data_error(tmp_path, monkeypatch, broken):
    write_bytes(tmp_path / "a", b"old")

    def fail(*_args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, broken, fail)
    with pytest.raises(DataError, match=r"a: cannot be written .No space left"):
        write_bytes(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"old" and os.listdir(tmp_path) == ["a"]


def test_a_file_in_place_of_a_folder_is_a_data_error(tmp_path):
    (tmp_path / "a").write_bytes(b"")
    with pytest.raises(DataError, match="cannot be written"):
        write_bytes(tmp_path / "a" / "b", b"")


def test_json_has_no_nan(tmp_path):
    write_json(tmp_path / "a.json", {"psnr": 31.5, "lpips": None, "name": "é"})
    assert json.loads((tmp_path / "a.json").read_text("utf-8")) == {"psnr": 31.5, "lpips": None, "name": "é"}
    with pytest.raises(ValueError):
        write_json(tmp_path / "a.json", {"psnr": float("nan")})
    assert json.loads((tmp_path / "a.json").read_text("utf-8"))["psnr"] == 31.5


def test_png_is_exact(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    write_png(tmp_path / "a.png", image)
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.png"), image)


@pytest.mark.parametrize(
    "image", [np.zeros((4, 4)), np.zeros((0, 4), np.uint8), np.zeros((4, 4, 2), np.uint8)], ids=str
)
def test_what_is_no_picture_is_refused(tmp_path, image):
    with pytest.raises(DataError, match="is not a picture"):
        write_png(tmp_path / "a.png", image)
    assert not (tmp_path / "a.png").exists()
