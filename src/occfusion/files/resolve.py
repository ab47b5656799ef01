"""From inert records to plain arrays, dicts and lists, once a pickle has been read to its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from occfusion.files.inert import (
    ArrayRecord,
    DtypeRecord,
    Global,
    Inert,
    KeptState,
    NotData,
    SetRecord,
    SparseMatrix,
    Unresolved,
)

Spend = Callable[[int], None]
"""Counts bytes that are about to be taken, and refuses when they are too many."""

_EXPRESSION = "it is an expression, not an array"
_NUMBER = 8
"""Bytes of the widest number that arrays are widened to."""

_SPARSE_PARTS = ("data", "data", "indices", "indptr", "row", "col", "coords")
"""Attributes that are widened; `data` twice, because each value gets a row and a column."""

MAX_DEPTH = 100
"""Deepest nesting of containers; real files have less than ten levels."""


def resolve(root: Any, budget: int) -> Any:
    """Returns `root` with every record replaced by its array, list, matrix or `Unresolved`.

    Args:
        root: what a pickle was read to.
        budget: bytes that objects of chumpy and scipy may be worked out to, all of them together.

    Raises:
        NotData: containers are nested deeper than `MAX_DEPTH`, an array never got its content, or the budget is
            spent.
    """
    return _Resolver(budget).visit(root, 0)


class _Resolver:
    """Walks shared and cyclic structures once: each container is replaced in one place."""

    def __init__(self, budget: int) -> None:
        self._budget = budget
        self._done: dict[int, Any] = {}
        self._alive: list[Any] = []  # keeps ids from being reused

    def visit(self, item: Any, depth: int) -> Any:
        if item is None or isinstance(item, (str, bytes, bytearray, int, float, complex)):
            return item
        if id(item) in self._done:
            return self._done[id(item)]
        if depth > MAX_DEPTH:
            raise NotData(f"containers nested deeper than {MAX_DEPTH}")
        self._alive.append(item)
        if isinstance(item, dict):
            return self._fill(item, {}, depth)
        if isinstance(item, list):
            return self._fill(item, [], depth)
        value = self._value(item, depth)
        self._done[id(item)] = value
        return value

    def _fill(self, item: Any, result: Any, depth: int) -> Any:
        self._done[id(item)] = result  # before its items: a container may hold itself
        if isinstance(item, dict):
            result.update((key, self.visit(value, depth + 1)) for key, value in item.items())
        else:
            result.extend(self.visit(value, depth + 1) for value in item)
        return result

    def _value(self, item: Any, depth: int) -> Any:
        if isinstance(item, tuple):
            return tuple(self.visit(value, depth + 1) for value in item)
        if isinstance(item, ArrayRecord):
            if item.array is None:
                raise NotData("an array without content")
            return self._array(item.array, depth)
        if isinstance(item, np.ndarray):
            return self._array(item, depth)
        if isinstance(item, DtypeRecord):
            return item.dtype()
        if isinstance(item, KeptState):
            self._done[id(item)] = Unresolved(item.name, "it refers to itself")
            state = self.visit(item.state, depth + 1)
            work_out = _sparse if item.name.startswith("scipy.") else _chumpy
            return work_out(item.name, state, self._spend)
        if isinstance(item, SetRecord):
            return item.items
        if isinstance(item, (Global, Inert)):
            return Unresolved(getattr(item, "name", type(item).__name__), "it is a class, not a value")
        raise NotData(f"a value of type {type(item).__name__}")

    def _spend(self, size: int) -> None:
        self._budget -= size
        if self._budget < 0:
            raise NotData("arrays that together are far larger than the file")

    def _array(self, array: NDArray[Any], depth: int) -> NDArray[Any]:
        if array.dtype.hasobject:
            flat = array.reshape(-1)
            for position in range(flat.size):
                flat[position] = self.visit(flat[position], depth + 1)
            return flat.reshape(array.shape)
        return array


def _chumpy(name: str, state: dict[str, Any], spend: Spend) -> Any:
    """Returns the array behind a chumpy object: a leaf, a reordering of one, or several in a row."""
    kind = name.rsplit(".", 1)[-1]
    try:
        if kind == "Concatenate":
            return _joined(name, state, spend)
        inner = state.get("a", state.get("x"))
        if not _is_numbers(inner):
            return Unresolved(name, _reason(inner))
        if kind == "Ch":
            return inner
        spend(inner.nbytes)  # each of these may copy it
        match kind:
            case "Select":
                picks = np.asarray(state["idxs"])
                spend(picks.size * inner.itemsize)
                picked = inner.ravel()[picks]
                return picked.reshape(state["preferred_shape"]) if "preferred_shape" in state else picked
            case "transpose":
                return np.transpose(inner, state.get("axes"))
            case "Reshape":
                return inner.reshape(state["newshape"])
    except (KeyError, IndexError, TypeError, ValueError) as error:
        return Unresolved(name, f"its parts do not fit ({error})")
    return Unresolved(name, _EXPRESSION)


def _joined(name: str, state: dict[str, Any], spend: Spend) -> Any:
    """Returns chumpy's `Concatenate`: its parts are attributes that `dterms` names in order."""
    parts = []
    for term in state["dterms"]:
        parts.append(state[term])
        if not _is_numbers(parts[-1]):
            return Unresolved(name, _reason(parts[-1]))
        spend(_NUMBER * (parts[-1].size + 1))
    return np.concatenate(parts, axis=state["axis"])


def _is_numbers(value: Any) -> TypeGuard[NDArray[Any]]:
    return isinstance(value, np.ndarray) and value.dtype.kind in "biuf"


def _reason(inner: Any) -> str:
    return inner.reason if isinstance(inner, Unresolved) else _EXPRESSION


def _sparse(name: str, state: dict[str, Any], spend: Spend) -> SparseMatrix | Unresolved:
    """Returns the matrix of a scipy state: compressed columns or rows, or coordinates."""
    try:
        rows, cols = (int(n) for n in state.get("_shape", state.get("shape")))  # type: ignore[union-attr]
        spend(_NUMBER * sum(np.size(state[key]) for key in _SPARSE_PARTS if key in state))
        data = np.asarray(state["data"], dtype=np.float64)
        if "coo" in name:
            row, col = state["coords"] if "coords" in state else (state["row"], state["col"])
        else:
            indptr = np.asarray(state["indptr"], dtype=np.int64)
            minor = np.asarray(state["indices"], dtype=np.int64)
            if indptr.size and (indptr[0] != 0 or indptr[-1] != data.size):
                raise ValueError("indptr does not cover the data")
            major = np.repeat(np.arange(indptr.size - 1), np.diff(indptr))
            row, col = (minor, major) if "csc" in name else (major, minor)
        row, col = np.asarray(row, dtype=np.int64), np.asarray(col, dtype=np.int64)
        if not (data.ndim == row.ndim == col.ndim == 1 and data.size == row.size == col.size):
            raise ValueError("data and indices differ in length")
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        if not inside.all():
            raise ValueError("an index lies outside the matrix")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        return Unresolved(name, f"its parts do not fit ({error})")
    return SparseMatrix(data, row, col, (rows, cols))
