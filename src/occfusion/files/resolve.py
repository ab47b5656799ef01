"""From inert records to plain arrays, dicts and lists, once a pickle has been read to its end."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.files.inert import (
    ArrayRecord,
    DtypeRecord,
    Global,
    Inert,
    KeptState,
    NotData,
    SparseMatrix,
    Unresolved,
)

MAX_DEPTH = 100
"""Deepest nesting of containers; real files have less than ten levels."""


def resolve(root: Any) -> Any:
    """Returns `root` with every record replaced by its array, matrix or `Unresolved`.

    Raises:
        NotData: containers are nested deeper than `MAX_DEPTH`, or an array never got its content.
    """
    return _Resolver().visit(root, 0)


class _Resolver:
    """Walks shared and cyclic structures once: each container is replaced in one place."""

    def __init__(self) -> None:
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
            return _sparse(item.name, state) if item.name.startswith("scipy.") else _chumpy(item.name, state)
        if isinstance(item, (Global, Inert)):
            return Unresolved(getattr(item, "name", type(item).__name__), "it is a class, not a value")
        raise NotData(f"a value of type {type(item).__name__}")

    def _array(self, array: NDArray[Any], depth: int) -> NDArray[Any]:
        if array.dtype.hasobject:
            flat = array.reshape(-1)
            for position in range(flat.size):
                flat[position] = self.visit(flat[position], depth + 1)
            return flat.reshape(array.shape)
        return array


def _chumpy(name: str, state: dict[str, Any]) -> Any:
    """Returns the array behind a chumpy object: a leaf, or a pure reordering of one."""
    inner = state.get("a", state.get("x"))
    if not isinstance(inner, np.ndarray):
        why = inner.reason if isinstance(inner, Unresolved) else "it is an expression, not an array"
        return Unresolved(name, why)
    try:
        match name.rsplit(".", 1)[-1]:
            case "Ch":
                return inner
            case "Select":
                picked = inner.ravel()[np.asarray(state["idxs"])]
                return picked.reshape(state["preferred_shape"]) if "preferred_shape" in state else picked
            case "transpose":
                return np.transpose(inner, state.get("axes"))
            case "Reshape":
                return inner.reshape(state["newshape"])
    except (KeyError, IndexError, TypeError, ValueError) as error:
        return Unresolved(name, f"its parts do not fit ({error})")
    return Unresolved(name, "it is an expression, not an array")


def _sparse(name: str, state: dict[str, Any]) -> SparseMatrix | Unresolved:
    """Returns the matrix of a scipy state: compressed columns or rows, or coordinates."""
    try:
        rows, cols = (int(n) for n in state.get("_shape", state.get("shape")))  # type: ignore[union-attr]
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
