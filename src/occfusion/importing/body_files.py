"""Opening the files of `bodies.py`: tensors alone, plain arrays, JSON, and pickles through the allow-list."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from occfusion.errors import DataError
from occfusion.files.arrays import load_npy, load_npz
from occfusion.files.joblibfile import load_joblib
from occfusion.files.jsonfile import parse_json


def load_file(path: Path, tool: str | None) -> Any:
    """Returns what a file holds; None for a motion, which has readers of its own.

    Raises:
        DataError: missing or damaged.
    """
    if not path.exists():
        raise DataError(f"{path}: file not found.")
    if path.is_dir():
        return {"easymocap": _json_rows(path)}
    suffix = path.suffix.lower()
    if suffix == ".pt":
        try:
            return torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # torch raises anything; nothing of the file was run
            raise DataError(
                f"{path}: cannot be read as tensors alone ({type(error).__name__}); nothing was executed. Save plain "
                "tensors with torch.save, or convert it where it is trusted."
            ) from error
    if suffix == ".npy":
        return load_npy(path)
    if suffix == ".smpl":
        return load_npz(path)
    if tool == "motion" or suffix == ".npz":
        return None
    return load_joblib(path)


def _json_rows(folder: Path) -> list[tuple[int, list[Any]]]:
    files = sorted(folder.glob("*.json"))
    if not files:
        raise DataError(f"{folder}: holds no .json files.")
    rows = []
    for file in files:
        try:
            content = parse_json(file.read_text(encoding="utf-8"))
            rows.append((int(file.stem), content["annots"] if isinstance(content, dict) else content))
        except (ValueError, KeyError, UnicodeDecodeError) as error:
            raise DataError(f"{file}: is no list of people as EasyMocap writes it ({error}).") from error
    return rows
