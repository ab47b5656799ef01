"""Stand-ins that pickle as chumpy's own objects do, in Python 2 as in Python 3, without chumpy.

mattloper/chumpy@ceebb48d, and version 0.70 as installed, `chumpy/ch.py` and `chumpy/reordering.py`. Read there:

* `Ch.__new__` gives every object `_dirty_vars` (a set: the names of parts that changed since the last evaluation, so
  `{"x"}` on a fresh array and empty on a used one), `_itr`, `_make_dense`, `_make_sparse`, `_depends_on_deps`, and the
  weak tables `_parents` and `_cache`, which alone `__getstate__` takes out. An evaluation adds `_status`.
* `Ch` keeps its float64 array as `x`. Indexing makes a `Select` of `a`, `idxs` (int64, into the flattened array) and
  `preferred_shape`; `concatenate` a `Concatenate` of `m0`, `m1`, ..., named in order by the attribute `dterms`, with
  `axis`, and with `_our_terms` once evaluated; `.T` a `transpose` of `a`, and `axes` and `dr_lookup` once evaluated;
  `reshape` a `Reshape` of `a` and `newshape`.

`chumpy_0_70.tar.xz` holds files that the real chumpy 0.70 wrote: in Python 2.7 with NumPy 1.16 and SciPy 1.2
(protocols 0 and 2), and in Python 3.8 with NumPy 1.23 and SciPy 1.8 (protocol 4), all of the arrays in its `truth.npz`.
"""

from __future__ import annotations

import contextlib
import io
import pickle
import struct
import sys
import types
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np

FORMER_NAMES = {
    "numpy._core.multiarray": "numpy.core.multiarray",
    "numpy._core.numeric": "numpy.core.numeric",
    "scipy.sparse._csc": "scipy.sparse.csc",
}
"""Modules as they were called when the body files were written."""


class Ch:
    """chumpy's array; instances hold the state that its `__getstate__` returns."""


class Select(Ch):
    """Entries of another array."""


class Concatenate(Ch):
    """Several arrays in a row."""


class transpose(Ch):
    """Another array with its axes exchanged."""


class Reshape(Ch):
    """Another array in another shape."""


MODULES = {"chumpy.ch": (Ch,), "chumpy.reordering": (Select, Concatenate, transpose, Reshape)}
for _module, _kinds in MODULES.items():
    for _kind in _kinds:
        _kind.__module__ = _module


def ch(array: np.ndarray) -> Ch:
    """`chumpy.array(array)`."""
    return _object(Ch, x=np.asarray(array, np.float64))


def select(array: np.ndarray, key: Any) -> Select:
    """`chumpy.array(array)[key]`; it asks the array for its shape, and so for its value."""
    places = np.arange(array.size).reshape(array.shape)[key]
    return _object(Select, a=used(ch(array)), idxs=places.ravel(), preferred_shape=places.shape)


def concatenate(arrays: list[np.ndarray], axis: int) -> Concatenate:
    """`chumpy.concatenate([chumpy.array(a) for a in arrays], axis=axis)`."""
    parts = {f"m{i}": ch(array) for i, array in enumerate(arrays)}
    joined = _object(Concatenate, **parts)
    joined.__dict__.update(dterms=list(parts), axis=axis)
    return joined


def transposed(array: np.ndarray) -> transpose:
    """`chumpy.array(array).T`."""
    return _object(transpose, a=ch(array))


def reshaped(array: np.ndarray, shape: tuple[int, ...]) -> Reshape:
    """`chumpy.array(array).reshape(shape)`."""
    return _object(Reshape, a=ch(array), newshape=shape)


def used(thing: Ch) -> Ch:
    """The same object after its value has been asked for."""
    parts = [part for part in vars(thing).values() if isinstance(part, Ch)]
    for part in parts:
        used(part)
    thing.__dict__.update(_dirty_vars=set(), _status="new")
    if isinstance(thing, Concatenate):
        thing.__dict__["_our_terms"] = parts
    if isinstance(thing, transpose):
        thing.__dict__.update(axes=None, dr_lookup={})
    return thing


def _object(kind: type[Any], **parts: Any) -> Any:
    thing = kind()
    thing.__dict__.update(
        _dirty_vars=set(parts), _itr=None, _make_dense=False, _make_sparse=False, _depends_on_deps={}, **parts
    )
    return thing


@contextlib.contextmanager
def chumpy_installed() -> Iterator[None]:
    """Lets the stand-ins be pickled under chumpy's names, and takes the names away again."""
    modules = {"chumpy": types.ModuleType("chumpy")}
    for name, kinds in MODULES.items():
        modules[name] = types.ModuleType(name)
        vars(modules[name]).update({kind.__name__: kind for kind in kinds})
    assert not set(modules) & set(sys.modules)
    sys.modules.update(modules)
    try:
        yield
    finally:
        for name in modules:
            del sys.modules[name]


def dumps(content: object, python: int, protocol: int) -> bytes:
    """Returns the pickle as Python 2 or 3 wrote it, with NumPy's and SciPy's names of before NumPy 2."""
    stream = io.BytesIO()
    with chumpy_installed():
        (_Python2 if python == 2 else _Python3)(stream, protocol).dump(content)
    return stream.getvalue()


class _Python3(pickle._Pickler):  # the pickler in Python: the other one writes names on its own
    dispatch: ClassVar[dict[type, Any]] = dict(pickle._Pickler.dispatch)

    def save_global(self, obj: Any, name: str | None = None) -> None:
        former = FORMER_NAMES.get(obj.__module__ or "")
        if former is None:
            super().save_global(obj, name)
        elif self.proto >= 4:
            self.save(former)
            self.save(obj.__name__)
            self.write(pickle.STACK_GLOBAL)
            self.memoize(obj)
        else:
            self.write(pickle.GLOBAL + f"{former}\n{obj.__name__}\n".encode())
            self.memoize(obj)

    dispatch[types.FunctionType] = save_global
    dispatch[types.BuiltinFunctionType] = save_global
    dispatch[type] = save_global


class _Python2(_Python3):
    """Text and bytes are one type there: an array's numbers are such a text. A dtype's flags are integers."""

    dispatch: ClassVar[dict[type, Any]] = dict(_Python3.dispatch)

    def save_text(self, obj: str | bytes) -> None:
        content = obj if isinstance(obj, bytes) else obj.encode("latin1")
        if not self.bin:
            self.write(b"S" + repr(content)[1:].encode() + b"\n")
        elif len(content) < 256:
            self.write(pickle.SHORT_BINSTRING + bytes([len(content)]) + content)
        else:
            self.write(pickle.BINSTRING + struct.pack("<i", len(content)) + content)
        self.memoize(obj)

    dispatch[str] = save_text
    dispatch[bytes] = save_text

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, np.dtype):
            make, (code, _, _), state = obj.__reduce__()
            return make, (code, 0, 1), state
        return NotImplemented
