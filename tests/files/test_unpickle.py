"""The data unpickler reads what data sets hold and runs nothing."""

from __future__ import annotations

import collections
import contextlib
import os
import pickle
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

from occfusion.errors import DataError
from occfusion.files.inert import SparseMatrix, Unresolved
from occfusion.files.unpickle import load_pickle, loads


def annots_like() -> dict:
    return {
        "cams": {"K": [np.eye(3)] * 3, "T": [np.arange(3.0).reshape(3, 1)]},
        "ims": [{"ims": ["a/0.jpg", "b/0.jpg"], "kpts2d": np.zeros((2, 25, 3), np.float32)}],
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "big_endian": np.arange(3, dtype=">i4"),
        "flags": np.array([True, False]),
        "text": np.array(["ab", "c"]),
        "empty": np.zeros((0, 3)),
        "scalar": np.float32(2.5),
        "ordered": collections.OrderedDict(a=1, b=[2, (3, None)]),
        "objects": np.array([{"x": np.ones(2)}, None], dtype=object),
        "bytes": b"\x00\xff",
        "nothing": b"",
        1: -(2**70),
    }


def assert_same(read, wanted) -> None:
    assert type(read) is type(wanted) or isinstance(wanted, (np.generic, collections.OrderedDict))
    if isinstance(wanted, dict):
        assert list(read) == list(wanted)
        for key in wanted:
            assert_same(read[key], wanted[key])
    elif isinstance(wanted, (list, tuple)):
        assert len(read) == len(wanted)
        for a, b in zip(read, wanted, strict=True):
            assert_same(a, b)
    elif isinstance(wanted, np.ndarray):
        assert read.shape == wanted.shape
        if wanted.dtype == object:
            for a, b in zip(read.ravel(), wanted.ravel(), strict=True):
                assert_same(a, b)
        else:
            assert read.dtype == wanted.dtype
            np.testing.assert_array_equal(read, wanted)
    else:
        assert read == wanted


@pytest.mark.parametrize("protocol", range(6))
def test_reads_what_real_files_hold(protocol):
    wanted = annots_like()
    assert_same(loads(pickle.dumps(wanted, protocol), "annots"), wanted)


def test_reads_both_numpy_module_names():
    content = pickle.dumps(np.arange(4.0), 2)
    assert b"numpy._core.multiarray" in content
    old = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    np.testing.assert_array_equal(loads(old, "old"), np.arange(4.0))


def test_reads_a_python_2_pickle():
    # written by hand as Python 2 wrote it: a str holds the bytes, the array is rebuilt from it
    content = (
        b"(dp0\nS'betas'\np1\ncnumpy.core.multiarray\n_reconstruct\np2\n(cnumpy\nndarray\np3\n(I0\ntp4\n"
        b"S'b'\np5\ntp6\nRp7\n(I1\n(I2\ntp8\ncnumpy\ndtype\np9\n(S'f8'\np10\nI0\nI1\ntp11\nRp12\n"
        b"(I3\nS'<'\np13\nNNNI-1\nI-1\nI0\ntp14\nbI00\nS'"
        + struct.pack("<2d", 1.5, -2.0).decode("latin1").encode("unicode_escape")
        + b"'\np15\ntp16\nbs."
    )
    assert_same(loads(content, "py2"), {"betas": np.array([1.5, -2.0])})


class Runs:
    """Pickles to a call of `function(*args)`."""

    def __init__(self, function, *args):
        self.call = function, args

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("function", [os.system, eval, exec, subprocess.Popen, __import__, getattr, open])
def test_refuses_calls_and_runs_nothing(tmp_path, function, protocol):
    trace = tmp_path / "ran"
    args = {
        os.system: (f"touch {trace}",),
        subprocess.Popen: (["touch", str(trace)],),
        open: (str(trace), "w"),
        getattr: (os, "system") if protocol < 0 else ("x", "join"),
        __import__: ("antigravity",),
    }.get(function, (f"open({str(trace)!r}, 'w')",))
    content = pickle.dumps({"cams": Runs(function, *args)}, protocol)
    with pytest.raises(DataError, match=r"annots\.npy: not allowed: .*nothing was executed"):
        loads(content, "annots.npy")
    assert not trace.exists()


ATTACKS = {
    "reduce on a method": b"cnumpy\nndarray.fromfile\n(S'/etc/passwd'\ntR.",
    "dotted name": b"\x80\x04\x8c\x05numpy\x8c\x0cndarray.dump\x93.",
    "instance opcode": b"(S'touch x'\nios\nsystem\n.",
    "object opcode": b"(cos\nsystem\nS'touch x'\no.",
    "extension code": b"\x80\x02\x82\x01.",
    "persistent id": b"Pmodule\n.",
    "state on a class": b"cnumpy\nndarray\n}S'__init__'\nI1\nsb.",
    "state on a function": b"cnumpy.core.multiarray\n_reconstruct\n(N}S'__code__'\nI1\nstb.",
    "state on a list": b"](I1\nI2\ntb.",
    "structured dtype": b"cnumpy\ndtype\n(S'O,f8'\nI0\nI1\ntR.",
    "dtype with a refcount flag": b"cnumpy\ndtype\n(S'V8'\nI0\nI1\ntR(I3\nS'|'\nNNNI8\nI1\nI63\ntb.",
    "dtype fields": b"cnumpy\ndtype\n(S'f8'\nI0\nI1\ntR(I3\nS'<'\nN(S'a'\nt}I8\nI1\nI0\ntb.",
    "subclass": b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\ndtype\n(I0\ntS'b'\ntR.",
    "codec": b"c_codecs\nencode\n(S'aaaa'\nS'zip'\ntR.",
    "other object": b"ccopy_reg\n_reconstructor\n(cnumpy\nndarray\nc__builtin__\nobject\nNtR.",
    "frozen set": b"\x80\x04(\x91.",
    "set that holds a class": b"\x80\x04\x8f(cnumpy\nndarray\n\x90.",
    "set that holds a class in a tuple": b"\x80\x04\x8f(cnumpy\nndarray\n\x85\x90.",
    "called set that holds a class": b"c__builtin__\nset\n((lcnumpy\nndarray\natR.",
    "set that holds what is not allowed": b"\x80\x04\x8f(cos\nsystem\n\x90.",
    "set in a set": b"\x80\x04\x8f(\x8f\x90.",
    "called set in a set": b"c__builtin__\nset\n((lc__builtin__\nset\n((ltRatR.",
    "set that holds itself": b"\x80\x04\x8f\x94(h\x00\x90.",
    "set of letters": b"c__builtin__\nset\n(S'abc'\ntR.",
    "set of nothing": b"c__builtin__\nset\n(tR.",
    "set with two arguments": b"c__builtin__\nset\n((l(ltR.",
    "state on a set": b"\x80\x04\x8f}S'add'\ncnumpy\nndarray\nsb.",
    "state on a called set": b"cbuiltins\nset\n((ltR}S'__reduce__'\nI1\nsb.",
    "state on the class of sets": b"cbuiltins\nset\n}S'x'\nI1\nsb.",
    "call of a set": b"\x80\x04\x8f(tR.",
    "item in a set": b"\x80\x04\x8fI1\nI1\ns.",
    "append to a set": b"\x80\x04\x8fI1\na.",
    "appends to a set": b"\x80\x04\x8f(I1\ne.",
    "set elements for a list": b"\x80\x04](I1\n\x90.",
    "set elements for a dict": b"\x80\x04}(I1\n\x90.",
    "set as a key": b"\x80\x04}\x8fI1\ns.",
    "set by the function for instances": b"ccopy_reg\n_reconstructor\n(c__builtin__\nset\nc__builtin__\nobject\nNtR.",
    "tuple as key": b"}(I1\ntI2\ns.",
    "append to a dict": b"}I1\na.",
}


@pytest.mark.parametrize("name", ATTACKS)
def test_refuses_crafted_opcodes(name):
    with pytest.raises(DataError, match="not allowed"):
        loads(ATTACKS[name], name)


def array_pickle(shape: bytes, dtype: bytes, content: bytes) -> bytes:
    return (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR(I1\n"
        + shape + b"cnumpy\ndtype\n(S'" + dtype + b"'\nI0\nI1\ntRI00\n" + content + b"tb."
    )  # fmt: skip


@pytest.mark.parametrize(
    ("shape", "dtype", "content"),
    [
        (b"(I1000000000000\nt", b"f8", b"S'abcd'\n"),
        (b"(I-1\nt", b"f8", b"S''\n"),
        (b"(I3\nt", b"O", b"(I1\nl"),  # NumPy itself would read two foreign pointers here
        (b"(I1\nt", b"f8", b"S'abc'\n"),
        (b"(F1.5\nt", b"f8", b"S'abcdefgh'\n"),
    ],
)
def test_refuses_arrays_whose_content_does_not_fill_them(shape, dtype, content):
    with pytest.raises(DataError, match="not allowed: an"):
        loads(array_pickle(shape, dtype, content), "array")


def test_array_state_can_be_given_only_once():
    once = array_pickle(b"(I1\nt", b"f8", b"S'abcdefgh'\n")[:-1]
    again = once + b"(I1\n(I0\ntcnumpy\ndtype\n(S'f8'\nI0\nI1\ntRI00\nS''\ntb."
    with pytest.raises(DataError, match="not allowed"):
        loads(again, "twice")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not a pickle",
        b"\x80\x04",
        b"\x80\x04\x96" + struct.pack("<Q", 2**62) + b"abc.",  # a byte array of 4 EB
        b"\x80\x04\x8e" + struct.pack("<Q", 2**62) + b"abc.",
        b"\x80\x04\x95" + struct.pack("<Q", 2**62) + b"abc.",
        b"(((((((.",
        b"0.",
        b"R.",
        b"h\x05.",
        b"I" + b"9" * 10000 + b"\n.",
        b"\x80\x09N.",
        b"]" * 20000 + b"a" * 19999 + b".",
    ],
)
def test_damage_is_an_error_with_the_name(content):
    with pytest.raises(DataError, match=r"^broken\.pkl: "):
        loads(content, "broken.pkl")


def test_a_huge_memo_index_takes_no_memory():
    assert loads(b"Nr\xff\xff\xff\x7f.", "memo") is None


def test_one_block_named_often_is_refused():
    block = b"S'" + b"a" * 80000 + b"'\np1\n0"
    one = array_pickle(b"(I10000\nt", b"f8", b"g1\n")[:-1]
    with pytest.raises(DataError, match="far larger than the file"):
        loads(b"(" + block + one * 1000 + b"l.", "bomb")


@pytest.mark.parametrize(
    "copy",
    [
        b"(c__builtin__\nset\n(g0\ntR",
        b"(ccollections\nOrderedDict\n(g1\ntR",
        array_pickle(b"(I50000\nt", b"O", b"g0\n")[:-1],
    ],
)
def test_one_list_copied_often_is_refused(copy):
    numbers = b"(lp0\n" + b"I1\na" * 50_000
    pairs = b"(lp1\n" + b"(I1\nI1\nla" * 50_000
    with pytest.raises(DataError, match="far larger than the file"):
        loads(b"(" + numbers + pairs + copy * 5000 + b"l.", "bomb")


def test_a_large_set_is_read_and_takes_no_hashes():
    content = b"\x80\x04\x8f(" + b"K\x01" * 500_000 + b"\x90."
    assert loads(content, "set") == [1] * 500_000


@pytest.mark.parametrize("protocol", range(6))
def test_sets_of_words_and_numbers_become_lists(protocol):
    wanted = {"b", "a", 3, 2.5, True, b"c"}
    read = loads(pickle.dumps({"words": wanted, "none": set()}, protocol), "set")
    assert isinstance(read["words"], list) and len(read["words"]) == len(wanted)
    assert set(read["words"]) == wanted and read["none"] == []


def test_mutations_never_escape():
    """Random damage gives data or a DataError: no other exception, no call."""
    rng = np.random.default_rng(0)
    for protocol in (0, 2, 4):
        content = pickle.dumps(annots_like(), protocol)
        sound = 0
        for _ in range(200):
            changed = bytearray(content)
            for _ in range(rng.integers(1, 4)):
                changed[rng.integers(len(changed))] = rng.integers(256)
            cut = len(changed) if rng.random() < 0.5 else rng.integers(1, len(changed) + 1)
            with contextlib.suppress(DataError):
                loads(bytes(changed[:cut]), "mutant")
                sound += 1
        assert 0 < sound < 200  # numbers inside arrays may change; opcodes and lengths hardly


class Ch:
    """Pickles as chumpy's classes do, under their names."""


def chumpy_pickle(state: dict, name: str = "Ch", protocol: int = 2, copies: int = 1) -> bytes:
    module = "chumpy.reordering" if name != "Ch" else "chumpy.ch"
    kind = type(name, (), {"__module__": module})
    things = [kind() for _ in range(copies)]
    for thing in things:
        thing.__dict__.update(state)
    import sys
    import types

    fake = types.ModuleType(module)
    setattr(fake, name, kind)
    sys.modules["chumpy"], sys.modules[module] = types.ModuleType("chumpy"), fake
    try:
        return pickle.dumps({"shapedirs": things[0], "others": things[1:]}, protocol)
    finally:
        del sys.modules["chumpy"], sys.modules[module]


@pytest.mark.parametrize("protocol", [0, 2])
def test_chumpy_arrays_are_read_without_chumpy(protocol):
    array = np.arange(6.0).reshape(2, 3)
    read = loads(chumpy_pickle({"x": array, "_dirty_vars": {"x"}, "_itr": None}, protocol=protocol), "smpl")
    np.testing.assert_array_equal(read["shapedirs"], array)


@pytest.mark.parametrize(
    ("name", "state", "wanted"),
    [
        ("Select", {"idxs": np.array([5, 0]), "preferred_shape": (2, 1)}, [[5.0], [0.0]]),
        ("transpose", {"axes": None}, [[0.0, 3.0], [1.0, 4.0], [2.0, 5.0]]),
        ("Reshape", {"newshape": (3, 2)}, [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]),
    ],
)
def test_chumpy_reorderings_are_followed(name, state, wanted):
    read = loads(chumpy_pickle({"a": np.arange(6.0).reshape(2, 3), **state}, name), "smpl")
    np.testing.assert_array_equal(read["shapedirs"], wanted)


def test_chumpy_parts_in_a_row_are_joined():
    parts = np.arange(4.0).reshape(2, 2), np.arange(6.0).reshape(2, 3)
    state = {"dterms": ["m0", "m1"], "m0": parts[0], "m1": parts[1], "axis": 1}
    read = loads(chumpy_pickle(state, "Concatenate"), "smpl")
    np.testing.assert_array_equal(read["shapedirs"], np.concatenate(parts, axis=1))


@pytest.mark.parametrize(
    ("name", "state"),
    [
        ("Concatenate", {"dterms": ["m0"], "axis": 0}),
        ("Concatenate", {"dterms": ["m0"], "m0": np.ones(3), "axis": 5}),
        ("Concatenate", {"dterms": 7, "axis": 0}),
        ("Concatenate", {"dterms": [["m0"]], "axis": 0}),
        ("Concatenate", {"dterms": [], "axis": 0}),
        ("Select", {"a": np.ones(3), "idxs": np.array([5])}),
        ("Select", {"a": np.ones(3), "idxs": np.array([0]), "preferred_shape": (7,)}),
        ("Select", {"a": np.array(["x"]), "idxs": np.array([0])}),
        ("Ch", {"x": np.array([None])}),
        ("Ch", {}),
    ],
)
def test_chumpy_objects_that_do_not_fit_stay_unresolved(name, state):
    read = loads(chumpy_pickle(state, name), "smpl")
    assert isinstance(read["shapedirs"], Unresolved)


@pytest.mark.parametrize(
    ("name", "state", "copies"),
    [
        ("Concatenate", {"dterms": ["m0"] * 50_000, "m0": np.ones(10_000), "axis": 0}, 1),
        ("Select", {"a": np.ones(30_000), "idxs": np.zeros(80_000, np.int8)}, 100),
        ("Reshape", {"a": np.ones((300, 300)).T, "newshape": -1}, 100),
    ],
)
def test_chumpy_objects_that_would_be_far_larger_than_the_file_are_refused(name, state, copies):
    with pytest.raises(DataError, match="far larger than the file"):
        loads(chumpy_pickle(state, name, copies=copies), "bomb")


def test_one_sparse_matrix_made_often_is_refused():
    sparse = pytest.importorskip("scipy.sparse")
    parts = sparse.csc_matrix(np.ones((100, 100))).__dict__
    many = []
    for _ in range(100):
        many.append(sparse.csc_matrix((1, 1)))
        many[-1].__dict__.update(parts)
    with pytest.raises(DataError, match="far larger than the file"):
        loads(pickle.dumps(many, 2), "bomb")


def test_chumpy_expressions_stay_unresolved():
    read = loads(chumpy_pickle({"a": np.ones(3), "axis": 0}, "Sort"), "smpl")
    assert isinstance(read["shapedirs"], Unresolved) and read["shapedirs"].name == "chumpy.reordering.Sort"


@pytest.mark.parametrize("kind", ["csc_matrix", "csr_matrix", "coo_matrix", "csc_array"])
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_scipy_matrices_become_coordinates(kind, protocol):
    sparse = pytest.importorskip("scipy.sparse")
    full = np.array([[0.0, 2.0, 0.0], [1.0, 0.0, -3.0]])
    read = loads(pickle.dumps(getattr(sparse, kind)(full), protocol), "smpl")
    assert isinstance(read, SparseMatrix)
    np.testing.assert_array_equal(read.dense(), full)


def test_shared_and_cyclic_containers_come_back_as_such():
    shared = [np.ones(2)]
    loop: list = [shared, shared]
    loop.append(loop)
    read = loads(pickle.dumps(loop, 4), "loop")
    assert read[0] is read[1] and read[2] is read
    np.testing.assert_array_equal(read[0][0], [1.0, 1.0])


def test_load_pickle_names_missing_and_too_large_files(tmp_path: Path, monkeypatch):
    with pytest.raises(DataError, match=r"absent.pkl: file not found"):
        load_pickle(tmp_path / "absent.pkl")
    with pytest.raises(DataError, match="is not a file"):
        load_pickle(tmp_path)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([1] * 100))
    monkeypatch.setattr("occfusion.files.unpickle.MAX_PICKLE_BYTES", 10)
    with pytest.raises(DataError, match="more than the 10"):
        load_pickle(tmp_path / "a.pkl")
