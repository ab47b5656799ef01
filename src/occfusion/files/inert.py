"""Inert stand-ins for what data pickles may name: they keep arrays and can do nothing else.

A pickle is a program that calls whatever it names. `unpickle.py` lets it name only the entries of
`GLOBALS` below, and each of them builds one of these records instead of the real object. NumPy's own
`dtype.__setstate__` and `ndarray.__setstate__` are never reached: with crafted flags or list lengths
they read foreign memory.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PLAIN_DTYPE = re.compile(r"[<>|=]?(b1|\?|i[1248]|u[1248]|f[248]|c8|c16|S[1-9]\d{0,5}|U[1-9]\d{0,5}|O8?)\Z")
_BYTE_ORDERS = "<>|="
_LATIN1 = ("latin1", "latin-1", "iso-8859-1")


class NotData(Exception):
    """The pickle asks for something that a record of arrays does not need; the text names it."""


@dataclass(frozen=True)
class Global:
    """A name the pickle may call: `build(*args)` makes a record or a plain value."""

    name: str
    build: Callable[..., Any]


class Inert:
    """A record that waits for its state and then gives its value; never the pickled class itself."""

    def set_state(self, state: Any) -> None:
        """Takes the state of the BUILD opcode once.

        Raises:
            NotData: the state has not the form that the class writes.
        """
        raise NotData(f"a state for {type(self).__name__}")


class DtypeRecord(Inert):
    """A NumPy dtype of numbers, booleans, text or objects; structured types are refused."""

    def __init__(self, code: object, *_flags: object) -> None:
        if not isinstance(code, str) or not _PLAIN_DTYPE.match(code):
            raise NotData(f"numpy.dtype({str(code)[:40]!r})")
        self._code = code.lstrip(_BYTE_ORDERS)
        self._order = code[0] if code[0] in _BYTE_ORDERS else "="

    def set_state(self, state: Any) -> None:
        """Takes the byte order; names, fields and sub-arrays must be absent."""
        if not isinstance(state, tuple) or len(state) < 5 or state[1] not in tuple(_BYTE_ORDERS):
            raise NotData("an unknown numpy.dtype state")
        if any(part is not None for part in state[2:5]):
            raise NotData("a structured numpy.dtype")
        self._order = state[1]

    def dtype(self) -> np.dtype[Any]:
        """Returns the real dtype."""
        return np.dtype(self._code if self._order == "|" else self._order + self._code)


class ArrayRecord(Inert):
    """An array: shape, dtype and bytes (or a list of objects), checked against each other."""

    def __init__(self) -> None:
        self.array: NDArray[Any] | None = None

    def set_state(self, state: Any) -> None:
        """Takes `(version, shape, dtype, is_fortran, bytes or list)`, or the same without version."""
        if self.array is not None or not isinstance(state, tuple) or len(state) not in (4, 5):
            raise NotData("an unknown numpy.ndarray state")
        shape, dtype, fortran, content = state[-4:]
        self.array = make_array(content, dtype, shape, "F" if fortran is True or fortran == 1 else "C")


class KeptState(Inert):
    """An object of a library that need not be installed; keeps its attributes."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.state: dict[str, Any] = {}

    def set_state(self, state: Any) -> None:
        """Keeps the attributes."""
        if not isinstance(state, dict):
            raise NotData(f"a state of {self.name} that is no dict")
        self.state = state


class SetRecord(Inert):
    """A set of words and numbers, kept in order: nothing is hashed, and nothing else may be in it.

    chumpy's arrays carry one: the names of their parts that changed last.
    """

    def __init__(self) -> None:
        self.items: list[str | bytes | int | float] = []

    def add(self, items: list[Any]) -> None:
        """Appends elements.

        Raises:
            NotData: one of them is no word or number.
        """
        for item in items:
            if not isinstance(item, (str, bytes, int, float)):
                raise NotData(f"a set element of type {type(item).__name__}")
        self.items.extend(items)


@dataclass(frozen=True)
class SparseMatrix:
    """A sparse matrix as coordinates, in place of scipy's classes.

    Attributes:
        data: values, `[n]`.
        row: row of each value, `[n]`.
        col: column of each value, `[n]`.
        shape: rows and columns.
    """

    data: NDArray[Any]
    row: NDArray[Any]
    col: NDArray[Any]
    shape: tuple[int, int]

    def dense(self) -> NDArray[np.float64]:
        """Returns the matrix in full; entries named twice add up, as in scipy."""
        full = np.zeros(self.shape, dtype=np.float64)
        np.add.at(full, (self.row, self.col), self.data)
        return full


@dataclass(frozen=True)
class Unresolved:
    """What stands where a value could not be had without running foreign code.

    Attributes:
        name: the pickled class.
        reason: why it has no value here.
    """

    name: str
    reason: str


def make_array(content: Any, dtype: Any, shape: Any, order: Any = "C") -> NDArray[Any]:
    """Returns the array of `content` (bytes, Latin-1 text or a list), whose length must fit exactly.

    Raises:
        NotData: types or lengths do not agree.
    """
    if isinstance(shape, int):
        shape = (shape,)
    if not isinstance(dtype, DtypeRecord) or not isinstance(shape, tuple) or len(shape) > 32:
        raise NotData("an array without a dtype or with a strange shape")
    if any(type(n) is not int or n < 0 for n in shape) or order not in ("C", "F"):
        raise NotData("an array with a strange shape")
    real, count = dtype.dtype(), math.prod(shape)
    if real.hasobject:
        if not isinstance(content, list) or len(content) != count:
            raise NotData("an object array whose list has another length")
        array = np.empty(count, dtype=object)
        for position, item in enumerate(content):  # assigning the list would look inside the items
            array[position] = item
        return array.reshape(shape, order=order)
    if isinstance(content, str):  # Python 2 wrote bytes as text
        content = content.encode("latin1")
    if not isinstance(content, (bytes, bytearray)) or len(content) != count * real.itemsize:
        raise NotData("an array whose bytes do not fill its shape")
    if count == 0:
        return np.empty(shape, dtype=real)
    return np.frombuffer(content, dtype=real).reshape(shape, order=order)


def _reconstruct(kind: Any, *_rest: Any) -> ArrayRecord:
    if not isinstance(kind, Global) or kind.name != "numpy.ndarray":
        raise NotData(f"an array of type {getattr(kind, 'name', type(kind).__name__)}")
    return ArrayRecord()


def _from_buffer(content: Any, dtype: Any, shape: Any, order: Any = "C", *_axes: Any) -> NDArray[Any]:
    return make_array(content, dtype, shape, order)


def _scalar(dtype: Any, content: Any = None) -> Any:
    return make_array([content] if isinstance(content, (list, dict)) else content, dtype, ()).item()


def _encode(text: Any, encoding: Any = "utf-8") -> bytes:
    if not isinstance(text, str) or encoding not in _LATIN1:  # other codecs can inflate without bound
        raise NotData(f"_codecs.encode to {str(encoding)[:40]!r}")
    return text.encode("latin1")


def _empty_bytes(*args: Any) -> bytes:
    if args:
        raise NotData("bytes() with arguments")
    return b""


def _ordered_dict(pairs: Any = ()) -> dict[Any, Any]:
    if not all(isinstance(p, (list, tuple)) and len(p) == 2 and isinstance(p[0], (str, int)) for p in pairs):
        raise NotData("an OrderedDict of something else than pairs")
    return {key: value for key, value in pairs}


def _instance(kind: Any, *_base: Any) -> Any:
    """The function by which Python 2 rebuilt plain objects: `copy_reg._reconstructor(cls, object, None)`."""
    if not isinstance(kind, Global) or kind.name.split(".")[0] not in ("chumpy", "scipy"):
        raise NotData(f"an object of {getattr(kind, 'name', type(kind).__name__)}")
    return kind.build()


def _set(*args: Any) -> SetRecord:
    """The call by which pickles up to protocol 3 and Python 2 rebuilt a set: `set([...])`."""
    if len(args) != 1 or not isinstance(args[0], list):
        raise NotData("a set that is not made of one list")
    record = SetRecord()
    record.add(args[0])
    return record


def never(*_args: Any) -> None:
    """Refuses the call of a class that may only be named."""
    raise NotData("a call of a class that may only be named")


def _table() -> Mapping[tuple[str, str], Global]:
    table: dict[tuple[str, str], Callable[..., Any]] = {
        ("numpy", "ndarray"): never,
        ("numpy", "dtype"): DtypeRecord,
        ("_codecs", "encode"): _encode,
        ("collections", "OrderedDict"): _ordered_dict,
    }
    for core in ("numpy.core", "numpy._core"):  # before and since NumPy 2
        table[f"{core}.multiarray", "_reconstruct"] = _reconstruct
        table[f"{core}.multiarray", "scalar"] = _scalar
        table[f"{core}.numeric", "_frombuffer"] = _from_buffer
    for builtins, copyreg in (("builtins", "copyreg"), ("__builtin__", "copy_reg")):
        table[builtins, "bytes"] = _empty_bytes
        table[builtins, "object"] = never
        table[builtins, "set"] = _set
        table[copyreg, "_reconstructor"] = _instance
    for kind in ("csc", "csr", "coo"):
        for module in (f"scipy.sparse.{kind}", f"scipy.sparse._{kind}"):
            for suffix in ("matrix", "array"):
                name = f"scipy.sparse.{kind}_{suffix}"
                table[module, f"{kind}_{suffix}"] = lambda name=name: KeptState(name)
    return {key: Global(".".join(key), build) for key, build in table.items()}


GLOBALS = _table()
"""Everything a pickle of arrays may name, both before and since NumPy 2, from Python 2 and 3."""


def chumpy_global(module: str, name: str) -> Global:
    """Returns the stand-in of a chumpy class: official SMPL files wrap arrays in them."""
    full = f"{module}.{name}"
    return Global(full, lambda *_args: KeptState(full))
