"""Binary glTF 2.0: a document in JSON and the arrays that it names, in one `.glb` file."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.files.atomic import write_bytes

_KINDS = {
    np.dtype(np.int8): 5120, np.dtype(np.uint8): 5121, np.dtype(np.int16): 5122, np.dtype(np.uint16): 5123,
    np.dtype(np.uint32): 5125, np.dtype(np.float32): 5126,
}  # fmt: skip
_SHAPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
VERTICES, INDICES = 34962, 34963
"""What a GPU binds an array as."""


class Glb:
    """A glTF document that is being put together.

    Attributes:
        document: everything but buffers and accessors; names arrays by what `add` returned.
    """

    def __init__(self) -> None:
        self.document: dict[str, Any] = {}
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []
        self._content = bytearray()

    def add(
        self,
        values: NDArray[Any],
        *,
        target: int | None = None,
        normalized: bool = False,
        bounds: bool = False,
    ) -> int:
        """Takes an array and returns its number.

        Args:
            values: `[N]`, `[N, 2..4]`, or `[N, 4, 4]` of matrices, row by row.
            target: `VERTICES`, `INDICES`, or None.
            normalized: whole numbers stand for fractions.
            bounds: say the least and the most of each column, which places and times have to.
        """
        kind, shape = _KINDS[values.dtype], _SHAPES[values.shape[1:]]
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._content), "byteLength": values.nbytes}
        if target is not None:
            view["target"] = target
        accessor: dict[str, Any] = {
            "bufferView": len(self._views), "componentType": kind, "count": len(values), "type": shape,
        }  # fmt: skip
        if normalized:
            accessor["normalized"] = True
        if bounds:
            rows = values.reshape(len(values), -1)
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        stored = values.transpose(0, 2, 1) if values.ndim == 3 else values  # matrices column by column
        self._content += np.ascontiguousarray(stored).tobytes()
        self._content += b"\0" * (-len(self._content) % 4)
        self._views.append(view)
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def write(self, path: Path | str) -> None:
        """Writes the file whole or not at all.

        Raises:
            DataError: the disk refuses.
        """
        whole = {
            "asset": {"version": "2.0", "generator": "occfusion"},
            **self.document,
            "buffers": [{"byteLength": len(self._content)}],
            "bufferViews": self._views,
            "accessors": self._accessors,
        }
        text = json.dumps(whole, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self._content), b"BIN\0") + self._content
        write_bytes(path, struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
