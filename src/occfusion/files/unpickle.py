"""An unpickler for data: arrays, numbers, text and containers, and nothing that could act.

Data sets of this field ship pickles (`annots.npy`, `params/*.npy`, SMPL's `.pkl`), and a pickle can call
any function it can name. Here every opcode that names, calls or changes an object goes through a
short table (`inert.GLOBALS`); anything else stops the reading with a `DataError` before it has happened.
"""

from __future__ import annotations

import io
import pickle
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

from occfusion.errors import DataError
from occfusion.files.inert import GLOBALS, Global, Inert, NotData, SetRecord, chumpy_global
from occfusion.files.resolve import resolve

MAX_PICKLE_BYTES = 1 << 30
"""Largest pickle that is read: SMPL with 300 components, written as escaped text, takes about 250 MB."""

_COPY_ALLOWANCE = 4
"""Arrays may add up to this many times the file; more is a small file that names one block often."""

_WORK_ALLOWANCE = 8
"""What chumpy's and scipy's objects are worked out to may add up to this many times the file."""

_SLACK = 1 << 20

_FOREIGN_OPCODES = {
    pickle.PERSID: "persistent ids",
    pickle.BINPERSID: "persistent ids",
    pickle.EXT1: "extension codes",
    pickle.EXT2: "extension codes",
    pickle.EXT4: "extension codes",
    pickle.INST: "old-style instances",
    pickle.OBJ: "old-style instances",
    pickle.NEWOBJ_EX: "instances with keyword arguments",
    pickle.NEXT_BUFFER: "out-of-band buffers",
    pickle.READONLY_BUFFER: "out-of-band buffers",
    pickle.FROZENSET: "frozen sets",
}


class DataUnpickler(pickle._Unpickler):
    """The interpreter in Python (not C), because there each opcode can be replaced.

    Its memo is a dict, so that a huge memo index costs nothing. The stream must not reserve memory for a declared
    length beyond its end: `io.BytesIO` does not, a file does.
    """

    stack: list[Any]
    metastack: list[list[Any]]
    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)

    def __init__(self, stream: Any, size: int) -> None:
        super().__init__(stream, fix_imports=False, encoding="latin1")
        self._array_budget = _COPY_ALLOWANCE * size + _SLACK
        self._work_budget = _WORK_ALLOWANCE * size + _SLACK

    def load(self) -> Any:
        """Returns the data, with every record replaced by its array.

        Raises:
            NotData: the pickle asks for something that is no data.
        """
        return resolve(super().load(), self._work_budget)

    def find_class(self, module: str, name: str) -> Global:
        """Returns the stand-in of a permitted name.

        Raises:
            NotData: the name is not in the table.
        """
        found = GLOBALS.get((module, name))
        if found is None and (module == "chumpy" or module.startswith("chumpy.")):
            found = chumpy_global(module, name)
        if found is None:
            raise NotData(f"{module}.{name}")
        return found

    def _call(self, function: Any, args: Any) -> Any:
        if not isinstance(function, Global):
            raise NotData(f"a call of {type(function).__name__}")
        if not isinstance(args, tuple):
            raise NotData(f"a call of {function.name} without an argument list")
        self._spend(args)
        return function.build(*args)

    def _spend(self, parts: Any) -> None:
        """Counts bytes, letters and elements that are about to be copied, which the file may name often."""
        if isinstance(parts, tuple):
            self._array_budget -= sum(len(p) for p in parts if isinstance(p, (bytes, bytearray, str, list)))
        if self._array_budget < 0:
            raise NotData("arrays that together are far larger than the file")

    def extend(self, target: Any, items: list[Any]) -> None:
        """Appends items, whole and ready, to a list that is being built."""
        if not isinstance(target, list):
            raise NotData(f"elements for {type(target).__name__}")
        target.extend(items)


def _reduce(machine: Any) -> None:
    args = machine.stack.pop()
    machine.stack[-1] = machine._call(machine.stack[-1], args)


def _new_object(machine: Any) -> None:
    args = machine.stack.pop()
    machine.append(machine._call(machine.stack.pop(), args))


def _build(machine: Any) -> None:
    state = machine.stack.pop()
    if not isinstance(machine.stack[-1], Inert):
        raise NotData(f"a state for {type(machine.stack[-1]).__name__}")
    machine._spend(state)
    machine.stack[-1].set_state(state)


def _store(target: Any, pairs: list[Any]) -> None:
    if not isinstance(target, dict) or len(pairs) % 2:
        raise NotData(f"items for {type(target).__name__}")
    for key, value in zip(pairs[::2], pairs[1::2], strict=True):
        if not isinstance(key, (str, bytes, int, float)):  # hashing nested tuples can exhaust the C stack
            raise NotData(f"a dict key of type {type(key).__name__}")
        target[key] = value


def _set_item(machine: Any) -> None:
    value, key = machine.stack.pop(), machine.stack.pop()
    _store(machine.stack[-1], [key, value])


def _set_items(machine: Any) -> None:
    pairs = machine.pop_mark()
    _store(machine.stack[-1], pairs)


def _dict(machine: Any) -> None:
    pairs = machine.pop_mark()
    target: dict[Any, Any] = {}
    _store(target, pairs)
    machine.append(target)


def _append(machine: Any) -> None:
    item = machine.stack.pop()
    machine.extend(machine.stack[-1], [item])


def _appends(machine: Any) -> None:
    items = machine.pop_mark()
    machine.extend(machine.stack[-1], items)


def _empty_set(machine: Any) -> None:
    machine.append(SetRecord())


def _add_items(machine: Any) -> None:
    items = machine.pop_mark()
    if not isinstance(machine.stack[-1], SetRecord):
        raise NotData(f"set elements for {type(machine.stack[-1]).__name__}")
    machine.stack[-1].add(items)


def _byte_array(machine: Any) -> None:
    (length,) = struct.unpack("<Q", machine.read(8))
    if length > MAX_PICKLE_BYTES:
        raise NotData(f"a block of {length} bytes")
    machine.append(bytearray(machine.read(length)))


def _refusal(what: str) -> Callable[[Any], None]:
    def refuse(_machine: Any) -> None:
        raise NotData(what)

    return refuse


DataUnpickler.dispatch.update({op[0]: _refusal(what) for op, what in _FOREIGN_OPCODES.items()})
DataUnpickler.dispatch.update(
    {
        pickle.REDUCE[0]: _reduce,
        pickle.NEWOBJ[0]: _new_object,
        pickle.BUILD[0]: _build,
        pickle.SETITEM[0]: _set_item,
        pickle.SETITEMS[0]: _set_items,
        pickle.DICT[0]: _dict,
        pickle.APPEND[0]: _append,
        pickle.APPENDS[0]: _appends,
        pickle.BYTEARRAY8[0]: _byte_array,
        pickle.EMPTY_SET[0]: _empty_set,
        pickle.ADDITEMS[0]: _add_items,
    }
)

_DAMAGE = (
    pickle.UnpicklingError,
    EOFError,
    LookupError,
    ValueError,
    TypeError,
    AttributeError,
    ArithmeticError,
    struct.error,
    RecursionError,
    MemoryError,
)


def loads(content: bytes, source: str) -> Any:
    """Returns the data of a pickle (protocols 0 to 5, Python 2 included) as arrays, dicts and lists.

    Args:
        content: the pickle.
        source: what error messages call it, usually the path.

    Raises:
        DataError: it names something outside the table, or is damaged. Nothing has been executed.
    """
    return explained(lambda: DataUnpickler(io.BytesIO(content), len(content)).load(), source)


def explained(read: Callable[[], Any], source: str) -> Any:
    """Returns the data that `read` unpickles; its errors become ours.

    Raises:
        DataError: as `loads`.
    """
    try:
        return read()
    except NotData as refusal:
        raise DataError(
            f"{source}: not allowed: {refusal}. The file asks for more than arrays, numbers and text; "
            "nothing was executed. Use a copy from the publisher, or convert it to .npz where it is trusted."
        ) from None
    except _DAMAGE as error:
        raise DataError(
            f"{source}: damaged or not a pickle ({type(error).__name__}: {error}); get the file again."
        ) from error


def load_pickle(path: Path | str) -> Any:
    """Returns the data of a pickle file as arrays, dicts and lists; executes nothing.

    Raises:
        DataError: the file is missing, larger than `MAX_PICKLE_BYTES`, damaged, or asks for anything
            outside the table.
    """
    return loads(read_bytes(Path(path), MAX_PICKLE_BYTES), str(path))


def read_bytes(path: Path, limit: int) -> bytes:
    """Returns the content of a regular file of at most `limit` bytes.

    Raises:
        DataError: it is missing, not a file, too large, or cannot be read.
    """
    try:
        size_within(path, limit)
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error}).") from error


def size_within(path: Path, limit: int) -> int:
    """Returns the size of a regular file, which must have at most `limit` bytes.

    Raises:
        DataError: it is missing, not a file, or too large.
        OSError: it cannot be looked at.
    """
    if not path.is_file():
        raise DataError(f"{path}: file not found." if not path.exists() else f"{path}: is not a file.")
    size = path.stat().st_size
    if size > limit:
        raise DataError(f"{path}: {size} bytes, more than the {limit} that are read.")
    return size
