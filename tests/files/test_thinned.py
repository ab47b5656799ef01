"""Parts of large pickles: the same content as read whole, refusals as strict, and memory that does not grow."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from occfusion.errors import DataError
from occfusion.files.thinned import load_thinned
from occfusion.files.unpickle import load_pickle

GONE = {"dropped": True}


def only(name: str):
    return lambda table: GONE if table.get("name", name) != name else None


def records(name: str, count: int, **shared) -> list[dict]:
    """Tables as data sets have them: text, arrays, a nested table, and what several tables hold in common."""
    rng = np.random.default_rng(len(name))
    return [
        {
            "name": name,
            "path": f"{name}/{k:05d}.jpg",
            "0": {"pose": rng.random(72), "betas": rng.random(10)},
            **shared,
        }
        for k in range(count)
    ]


def same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and np.array_equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return a == b


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("wanted", ["a", "b", "c"])
def test_what_is_kept_is_what_the_whole_file_has(protocol, wanted, tmp_path):
    size = (1080, 1920)
    content = [[records(name, count, size=size) for count in (2, 1100)] for name in "abc"]
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    whole, part = load_pickle(path), load_thinned(path, only(wanted))
    place = "abc".index(wanted)
    assert same(part[place], whole[place])
    for other in {0, 1, 2} - {place}:
        assert [len(rows) for rows in part[other]] == [2, 1100]
        assert all(row == GONE for rows in part[other] for row in rows)


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_what_was_dropped_and_is_named_again_comes_back(protocol, tmp_path):
    matrix, words = np.eye(3), ["some", "words"]
    late = records("a", 600)
    late[555] |= {"matrix": matrix, "words": words, "again": late[3]}  # deep inside what is dropped
    content = [late, records("b", 5, matrix=matrix, words=words, other=late[3]["0"])]
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    part = load_thinned(path, only("b"))
    assert same(part[1], load_pickle(path)[1])
    np.testing.assert_array_equal(part[1][4]["matrix"], np.eye(3))


def test_tables_that_hold_themselves_and_lists_of_other_things(tmp_path):
    own = {"name": "a"}
    own["own"] = own
    content = [[own, *records("a", 3)], [1, "x", {"name": "a"}, {"name": "b", "k": [{"name": "b", "z": 1}]}]]
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps(content))
    part = load_thinned(path, only("b"))
    assert part == [[GONE] * 4, [1, "x", GONE, {"name": "b", "k": [{"name": "b", "z": 1}]}]]


@pytest.mark.parametrize("protocol", [0, 4])
def test_code_is_refused_even_in_what_would_be_dropped(protocol, tmp_path):
    class Runs:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'ran'}",)

    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps([[*records("a", 9), {"name": "a", "x": Runs()}]], protocol=protocol))
    with pytest.raises(DataError, match=r"x\.pkl: not allowed: \w+\.system"):
        load_thinned(path, only("b"))
    assert not (tmp_path / "ran").exists()


def test_damaged_and_missing_files(tmp_path):
    path = tmp_path / "x.pkl"
    with pytest.raises(DataError, match=r"x\.pkl: file not found"):
        load_thinned(path, only("b"))
    whole = pickle.dumps([records("a", 50), records("b", 50)])
    for cut in (0, 1, 30, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(DataError, match=r"x\.pkl: damaged or not a pickle"):
            load_thinned(path, only("b"))
    # 2**62 bytes announced, and an object that was never numbered
    for bad in (
        b"\x80\x04\x8e" + (1 << 62).to_bytes(8, "little") + b"x.",
        b"\x80\x02]q\x00h\x07a.",
        b"]q\x09h\x07a.",
    ):
        path.write_bytes(bad)
        with pytest.raises(DataError, match=r"x\.pkl: damaged or not a pickle"):
            load_thinned(path, only("b"))


MEASURE = """
import json, sys
from occfusion.files.thinned import load_thinned
from occfusion.files.unpickle import load_pickle
def peak():  # of this process alone; getrusage would count that of the one that started it
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM")) / 1024
start, gone = peak(), {}
part = load_thinned(sys.argv[1], lambda table: gone if table.get("name", "s1") != "s1" else None)
one = peak()
load_pickle(sys.argv[1])
print(json.dumps([one - start, peak() - start, len(part[1])]))
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from Linux's /proc")
@pytest.mark.parametrize(
    ("sequences", "megabytes"), [(20, 20), pytest.param(200, 35, marks=pytest.mark.slow)]
)
def test_memory_is_that_of_what_is_kept(sequences, megabytes, tmp_path):
    path = tmp_path / "x.pkl"
    with path.open("wb") as file:
        pickle.dump([records(f"s{k}", 500) for k in range(sequences)], file)
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, str(path)], capture_output=True, text=True, check=True
    )
    part, whole, kept = json.loads(done.stdout)
    assert kept == 500 and part < megabytes, (part, whole)
    assert whole > 2.5 * part, (part, whole)
