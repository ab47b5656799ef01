"""`.npy` and `.npz` without NumPy's pickle support."""

from __future__ import annotations

import os
import zipfile

import numpy as np
import pytest

from occfusion.errors import DataError
from occfusion.files.arrays import load_npy, load_npz


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6).reshape(2, 3)),
        np.zeros((0, 4)),
        np.array(3.0),
    ],
)
def test_plain_arrays(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    read = load_npy(tmp_path / "a.npy")
    assert read.dtype == array.dtype
    np.testing.assert_array_equal(read, array)


def test_a_pickled_dict_comes_back_as_a_dict(tmp_path):
    np.save(tmp_path / "a.npy", {"poses": np.ones((1, 72))}, allow_pickle=True)
    assert load_npy(tmp_path / "a.npy")["poses"].shape == (1, 72)


def test_code_in_an_object_array_is_refused_and_does_not_run(tmp_path):
    class Runs:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'ran'}",)

    path = tmp_path / "annots.npy"
    np.save(path, {"cams": Runs()}, allow_pickle=True)
    with pytest.raises(DataError, match=rf"{path}: not allowed: (posix|nt)\.system"):
        load_npy(path)
    assert not (tmp_path / "ran").exists()
    np.load(path, allow_pickle=True)  # the file is live: NumPy's reader does run it
    assert (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"junk",
        b"\x93NUMPY",
        b"\x93NUMPY\x09\x00\x10\x00{}",
        b"\x93NUMPY\x01\x00\x10\x00((((((((((((((((",
    ],
)
def test_damaged_headers(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(DataError, match=r"a\.npy: not a NumPy file, or damaged"):
        load_npy(tmp_path / "a.npy")


def test_cut_short_and_huge_declared_size(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros(1000))
    content = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(content[:-100])
    with pytest.raises(DataError, match="cut short"):
        load_npy(tmp_path / "a.npy")
    huge = content.replace(b"(1000,), }" + 9 * b" ", b"(9999999999999,), }")
    assert len(huge) == len(content) and huge != content
    (tmp_path / "a.npy").write_bytes(huge)
    with pytest.raises(DataError, match=r"a\.npy: .*(declares|cut short)"):
        load_npy(tmp_path / "a.npy")


def test_npz_reads_only_what_is_asked_and_refuses_objects(tmp_path, monkeypatch):
    np.savez(tmp_path / "a.npz", x=np.ones(3), y=np.zeros(2))
    assert set(load_npz(tmp_path / "a.npz")) == {"x", "y"}
    assert set(load_npz(tmp_path / "a.npz", ("x", "z"))) == {"x"}
    np.savez(tmp_path / "b.npz", x=np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(DataError, match=r"b\.npz\[x\]: holds Python objects"):
        load_npz(tmp_path / "b.npz")
    monkeypatch.setattr("occfusion.files.arrays.MAX_ARRAY_BYTES", 100)
    with pytest.raises(DataError, match=r"a\.npz\[x\]: declares"):
        load_npz(tmp_path / "a.npz")


def test_npz_missing_and_damaged(tmp_path):
    with pytest.raises(DataError, match="not found"):
        load_npz(tmp_path / "a.npz")
    (tmp_path / "a.npz").write_bytes(b"PK not really")
    with pytest.raises(DataError, match=r"not a .npz archive"):
        load_npz(tmp_path / "a.npz")
    with zipfile.ZipFile(tmp_path / "c.npz", "w") as archive:
        archive.writestr("x.npy", b"junk")
    with pytest.raises(DataError, match=r"c\.npz\[x\]"):
        load_npz(tmp_path / "c.npz")
