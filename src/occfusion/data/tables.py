"""Tables of frames, as pickles and JSON files hold them: `{frame: {key: value}}`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from occfusion.errors import DataError
from occfusion.files.unpickle import load_pickle


def load_table(path: Path) -> Mapping[str, Any]:
    """Returns the table in a pickle; executes nothing.

    Raises:
        DataError: the file is missing or damaged, or holds no table.
    """
    return table(load_pickle(path), path)


def table(content: Any, path: Path) -> Mapping[str, Any]:
    """Returns the content of a file that must hold a table of frames or values.

    Raises:
        DataError: it holds something else, nothing, or keys that are not text.
    """
    if not isinstance(content, Mapping) or not content:
        raise DataError(f"{path}: holds a {type(content).__name__}, not a table of frames.")
    if not all(isinstance(key, str) for key in content):
        raise DataError(f"{path}: the frames must be named by text, as 'frame_000000'.")
    return content


def entry(rows: Mapping[str, Any], name: str, path: Path) -> Mapping[str, Any]:
    """Returns the row of a frame, which must be a table itself."""
    row = rows[name]
    if not isinstance(row, Mapping):
        raise DataError(f"{path}, {name}: holds a {type(row).__name__}, not a table.")
    return row


def need(row: Mapping[str, Any], key: str, where: str) -> Any:
    """Returns the value of a key.

    Raises:
        DataError: it is missing; says what is there.
    """
    if key not in row:
        raise DataError(f"{where}: key {key!r} is missing; it has {', '.join(map(str, row))[:200]}.")
    return row[key]
