"""Files of joblib as data: the pickle's allow-list, and arrays that lie between its opcodes.

Written as joblib/joblib `joblib/numpy_pickle.py` (1.5) writes them: behind the state of each `NumpyArrayWrapper` come
a byte that says how many bytes of padding follow, these, and the array's bytes. The whole may be compressed by zlib.
"""

from __future__ import annotations

import io
import math
import zlib
from pathlib import Path
from typing import Any, ClassVar

from occfusion.errors import DataError
from occfusion.files.inert import DtypeRecord, Global, KeptState, NotData, make_array, never
from occfusion.files.unpickle import MAX_PICKLE_BYTES, DataUnpickler, explained, read_bytes

_WRAPPER = "joblib.numpy_pickle.NumpyArrayWrapper"
_BUILD = ord("b")
_ZLIB = b"\x78"


def load_joblib(path: Path | str) -> Any:
    """Returns the data of a file of joblib as arrays, dicts and lists; executes nothing.

    Raises:
        DataError: missing, too large, damaged, compressed by another method than zlib, or it asks for more than data.
    """
    content = read_bytes(Path(path), MAX_PICKLE_BYTES)
    if content[:1] == _ZLIB:
        machine = zlib.decompressobj()
        try:
            content = machine.decompress(content, MAX_PICKLE_BYTES)
        except zlib.error as error:
            raise DataError(f"{path}: damaged ({error}); get the file again.") from error
        if machine.unconsumed_tail:
            raise DataError(f"{path}: more than {MAX_PICKLE_BYTES} bytes once unpacked.")
    return explained(lambda: _JoblibUnpickler(io.BytesIO(content), len(content)).load(), str(path))


class _JoblibUnpickler(DataUnpickler):
    dispatch: ClassVar[dict[int, Any]] = dict(DataUnpickler.dispatch)

    def find_class(self, module: str, name: str) -> Global:
        if f"{module}.{name}" == _WRAPPER:
            return Global(_WRAPPER, lambda: KeptState(_WRAPPER))
        if (module, name) == ("collections", "defaultdict"):  # its factory is named and never called
            return Global("collections.defaultdict", lambda *_default: {})
        if module == "builtins" and name in ("dict", "list"):
            return Global(f"builtins.{name}", never)
        return super().find_class(module, name)


def _build(machine: Any) -> None:
    DataUnpickler.dispatch[_BUILD](machine)
    record = machine.stack[-1]
    if not isinstance(record, KeptState) or record.name != _WRAPPER:
        return
    state = record.state
    shape, dtype = state.get("shape"), state.get("dtype")
    if not isinstance(dtype, DtypeRecord) or not isinstance(shape, tuple) or dtype.dtype().hasobject:
        raise NotData("an array of joblib without a plain dtype and shape")
    if any(type(n) is not int or n < 0 for n in shape):
        raise NotData("an array of joblib with a strange shape")
    if state.get("numpy_array_alignment_bytes") is not None:
        machine.read(machine.read(1)[0])
    size = math.prod(shape) * dtype.dtype().itemsize
    if size > MAX_PICKLE_BYTES:
        raise NotData(f"an array of {size} bytes")
    content = machine.read(size)
    machine._spend((content,))
    order = state.get("order")
    machine.stack[-1] = make_array(content, dtype, shape, order if order in ("C", "F") else "C")


_JoblibUnpickler.dispatch[_BUILD] = _build
