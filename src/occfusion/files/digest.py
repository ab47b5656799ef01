"""Fingerprints of files, so that what another program or a bad disk did to them is seen before they are taken over."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path


def digest(path: Path) -> str:
    """Returns a fingerprint of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()[:16]


def digest_of_values(values: object) -> str:
    """Returns a fingerprint of nested plain values, however a file orders or spells them."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def digests(folder: Path, files: Iterable[Path]) -> dict[str, str]:
    """Returns the fingerprints of those of some files that are there, by their names within a folder."""
    return {file.relative_to(folder).as_posix(): digest(file) for file in files if file.is_file()}


def changed(folder: Path, known: Mapping[str, str]) -> list[Path]:
    """Returns the files in a folder that are missing, or not those of the known fingerprints."""
    files = {folder / name: value for name, value in known.items()}
    return [file for file, value in files.items() if not file.is_file() or digest(file) != value]
