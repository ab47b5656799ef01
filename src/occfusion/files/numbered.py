"""Folders of numbered files, which appear whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from occfusion.errors import DataError


def numbered(row: int, suffix: str) -> str:
    """Returns the name of a file, such as `0012.png`."""
    return f"{row:04d}{suffix}"


@contextmanager
def folder_beside(path: Path) -> Iterator[Path]:
    """Yields a folder on the disk of `path`, for what is not whole yet.

    Raises:
        DataError: the disk refuses.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = TemporaryDirectory(prefix=f".{path.name[:80]}.", dir=path.parent)
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror}); check space and rights.") from error
    with folder as name:
        yield Path(name)


def put_in_place(folder: Path, place: Path, suffix: str, count: int) -> None:
    """Moves the files `0000`, `0001`, ... of a folder to their place, where those of an earlier call give way.

    Other files stay.

    Args:
        folder: that has them all.
        place: where they go.
        suffix: of the files.
        count: how many there are.

    Raises:
        DataError: the disk refuses.
    """
    try:
        place.mkdir(parents=True, exist_ok=True)
        for file in folder.glob(f"*{suffix}"):
            file.replace(place / file.name)
        for old in place.glob(f"[0-9][0-9][0-9][0-9]*{suffix}"):
            if old.stem.isdigit() and int(old.stem) >= count:
                old.unlink()
    except OSError as error:
        raise DataError(f"{place}: cannot be written ({error.strerror}); check space and rights.") from error
