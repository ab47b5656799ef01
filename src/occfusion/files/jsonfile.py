"""Reading JSON from outside, with bounds on size and depth and an error that names the place."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from occfusion.errors import DataError
from occfusion.files.unpickle import read_bytes

MAX_JSON_BYTES = 256 << 20
"""Largest file that is read: 10 000 frames with cameras and poses take about 30 MB."""


def parse_json(content: str | bytes) -> Any:
    """Returns what a JSON text says.

    Raises:
        ValueError: it is none, or nested so deeply that nobody can have meant it.
    """
    try:
        return json.loads(content)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def load_json(path: Path | str) -> Any:
    """Returns the content of a JSON file.

    Raises:
        DataError: missing, too large, nested too deeply, or damaged; says at which line.
    """
    path = Path(path)
    content = read_bytes(path, MAX_JSON_BYTES)
    try:
        return parse_json(content)
    except json.JSONDecodeError as error:
        raise DataError(
            f"{path}: not JSON, or damaged, at line {error.lineno} ({error.msg}); get the file again."
        ) from error
    except ValueError as error:  # UTF-8, numbers of thousands of digits, nesting
        raise DataError(f"{path}: not JSON, or damaged ({error}); get the file again.") from error
