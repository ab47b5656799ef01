"""Reading `.npy` and `.npz` without NumPy's own pickle support, sizes checked before memory is taken."""

from __future__ import annotations

import io
import math
import tokenize
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.unpickle import MAX_PICKLE_BYTES, loads, read_bytes

MAX_ARRAY_BYTES = 1 << 30
"""Largest single array that is read: SMPL-X with 400 components takes 100 MB."""

_MAX_HEADER = 1 << 16
_HEADER_DAMAGE = (
    *(ValueError, TypeError, SyntaxError, EOFError, MemoryError, RecursionError),
    tokenize.TokenError,  # NumPy tidies headers that Python 2 wrote with the tokenizer
)


def load_npy(path: Path | str) -> Any:
    """Returns the array of a `.npy` file; for a pickled single object (a dict, a list), that object.

    Raises:
        DataError: missing, damaged, too large, or a pickle that asks for more than data.
    """
    path = Path(path)
    return _parse(read_bytes(path, MAX_PICKLE_BYTES), str(path))


def npy_form(path: Path | str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Returns shape and dtype of a `.npy` file, reading only its beginning.

    Raises:
        DataError: missing, or not a NumPy file.
    """
    try:
        with Path(path).open("rb") as stream:
            shape, _, dtype = _header(io.BytesIO(stream.read(_MAX_HEADER)))
    except FileNotFoundError:
        raise DataError(f"{path}: file not found.") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error}).") from error
    except _HEADER_DAMAGE as error:
        raise DataError(f"{path}: not a NumPy file, or damaged ({error}); get the file again.") from error
    return shape, dtype


def _parse(content: bytes, source: str) -> Any:
    stream = io.BytesIO(content)
    try:
        shape, fortran, dtype = _header(stream)
    except _HEADER_DAMAGE as error:
        raise DataError(f"{source}: not a NumPy file, or damaged ({error}); get the file again.") from error
    body = content[stream.tell() :]
    if dtype.hasobject:
        data = loads(body, source)
        if isinstance(data, np.ndarray) and data.dtype.hasobject and data.shape == ():
            return data.item()
        return data
    expected = math.prod(shape) * dtype.itemsize
    if len(body) < expected:
        raise DataError(f"{source}: holds {len(body)} bytes of {expected}; it was cut short, get it again.")
    if expected == 0:
        return np.empty(shape, dtype=dtype)
    flat = np.frombuffer(body, dtype=dtype, count=math.prod(shape))
    return flat.reshape(shape, order="F" if fortran else "C")


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Returns shape, column order and dtype; the header is a literal and is parsed as one."""
    version = npy.read_magic(stream)
    if version == (1, 0):
        return npy.read_array_header_1_0(stream, max_header_size=_MAX_HEADER)
    if version == (2, 0):
        return npy.read_array_header_2_0(stream, max_header_size=_MAX_HEADER)
    raise ValueError(f"format version {version}")


def load_npz(path: Path | str, keys: tuple[str, ...] | None = None) -> dict[str, NDArray[Any]]:
    """Returns the arrays of a `.npz` file; object arrays inside are refused.

    Args:
        path: the archive.
        keys: read only these, where present; all when None.

    Raises:
        DataError: missing, damaged, or an array declared larger than `MAX_ARRAY_BYTES`.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: file not found.")
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {i.filename.removesuffix(".npy"): i for i in archive.infolist()}
            wanted = [name for name in entries if keys is None or name in keys]
            return {name: _member(archive, entries[name], f"{path}[{name}]") for name in wanted}
    except (zipfile.BadZipFile, OSError, EOFError, NotImplementedError, RuntimeError) as error:
        raise DataError(f"{path}: not a .npz archive, or damaged ({error}); get the file again.") from error


def _member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, source: str) -> NDArray[Any]:
    if entry.file_size > MAX_ARRAY_BYTES:
        raise DataError(f"{source}: declares {entry.file_size} bytes, more than {MAX_ARRAY_BYTES}.")
    with archive.open(entry) as stream:
        content = stream.read(entry.file_size + 1)  # never more than was declared and checked
    if len(content) > entry.file_size:
        raise DataError(f"{source}: larger than it declares; get the file again.")
    array = _parse(content, source)
    if not isinstance(array, np.ndarray) or array.dtype.hasobject:
        raise DataError(
            f"{source}: holds Python objects; only plain arrays are read from a .npz. Save it again as numbers: "
            "a sparse matrix by way of .toarray(), a chumpy object by way of np.array()."
        )
    return array
