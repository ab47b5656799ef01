"""Writing files, and folders of numbered files, whole or not at all: temporary name, flush to the disk, rename."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError

_PARTIAL = ".partial"


@contextlib.contextmanager
def atomic_write(path: Path | str) -> Iterator[IO[bytes]]:
    """Yields a binary stream; the file appears under its name only when the block ends without error.

    Missing folders are made. On any error, also an interrupt, a file that was there before stays as it
    was, and the temporary one is removed.

    Raises:
        DataError: the disk refuses (full, read-only, not permitted).
    """
    path = Path(path)
    with _explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name[:80]}.", suffix=_PARTIAL, dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as stream:
                os.chmod(name, 0o666 & ~_umask())  # mkstemp gives 0600, which others could not read
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(name, path)
        finally:
            Path(name).unlink(missing_ok=True)  # gone where all went well
        _sync_folder(path.parent)


def make_writable(folder: Path) -> None:
    """Makes a folder where it is missing, before the work whose result it is to hold.

    Raises:
        DataError: it cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise DataError(f"{folder}: cannot be written ({error.strerror}); name another folder") from error


def write_bytes(path: Path | str, content: bytes) -> None:
    """Writes `content` whole or not at all."""
    with atomic_write(path) as stream:
        stream.write(content)


def create_bytes(path: Path | str, content: bytes) -> bool:
    """Writes a file that must not exist yet, whole; returns False, and writes nothing, where it exists.

    Of several processes that try at once exactly one is told True.

    Raises:
        OSError: the disk refuses.
    """
    path = Path(path)
    handle, name = tempfile.mkstemp(prefix=f".{path.name[:80]}.", suffix=_PARTIAL, dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as stream:
            os.chmod(name, 0o666 & ~_umask())
            stream.write(content)
        try:
            os.link(name, path)
        except FileExistsError:
            return False
        except OSError:  # a disk without links: a reader may see the file before its content
            try:
                path.open("xb").close()
            except FileExistsError:
                return False
            os.replace(name, path)
        return True
    finally:
        Path(name).unlink(missing_ok=True)


def write_json(path: Path | str, content: Mapping[str, Any] | list[Any]) -> None:
    """Writes readable JSON; NaN and infinity are refused, since other readers reject them.

    Raises:
        ValueError: a number is not finite; write None where a figure could not be computed.
    """
    write_bytes(path, json_bytes(content))


def json_bytes(content: Mapping[str, Any] | list[Any]) -> bytes:
    """Returns readable JSON; raises as `write_json`."""
    return (json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n").encode()


def write_png(path: Path | str, image: NDArray[Any]) -> None:
    """Writes a PNG.

    Args:
        path: the file.
        image: uint8 `[H, W]`, `[H, W, 3]` (RGB) or `[H, W, 4]` (RGB and straight alpha), uint16 `[H, W]`, or bool
            `[H, W]`, which is written as 0 and 255.

    Raises:
        DataError: another type or shape, or the encoder refuses it.
    """
    if image.dtype == np.bool_:
        image = image.astype(np.uint8) * np.uint8(255)
    is_picture = image.dtype == np.uint8 and (image.ndim == 2 or image.shape[2:] in ((3,), (4,)))
    is_deep = image.dtype == np.uint16 and image.ndim == 2
    if image.size == 0 or not (is_picture or is_deep):
        raise DataError(f"{path}: an array of {image.dtype} {image.shape} is not a picture.")
    order = {3: [2, 1, 0], 4: [2, 1, 0, 3]}
    ordered = image if image.ndim == 2 else np.ascontiguousarray(image[..., order[image.shape[2]]])
    done, encoded = cv2.imencode(".png", ordered)
    if not done:
        raise DataError(f"{path}: the picture {image.shape} could not be encoded.")
    write_bytes(path, encoded.tobytes())


def numbered(row: int, suffix: str) -> str:
    """Returns the name of a file, such as `0012.png`."""
    return f"{row:04d}{suffix}"


@contextlib.contextmanager
def folder_beside(path: Path) -> Iterator[Path]:
    """Yields a folder on the disk of `path`, for what is not whole yet.

    Raises:
        DataError: the disk refuses.
    """
    with _explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = tempfile.TemporaryDirectory(prefix=f".{path.name[:80]}.", dir=path.parent)
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
    with _explained(place):
        place.mkdir(parents=True, exist_ok=True)
        for file in folder.glob(f"*{suffix}"):
            file.replace(place / file.name)
        for old in place.glob(f"[0-9][0-9][0-9][0-9]*{suffix}"):
            if old.stem.isdigit() and int(old.stem) >= count:
                old.unlink()


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Says which file could not be written, and what to do."""
    try:
        yield
    except OSError as error:
        why = error.strerror or error
        raise DataError(f"{path}: cannot be written ({why}); check space and rights.") from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _sync_folder(folder: Path) -> None:
    """Makes the rename itself durable; not all file systems can, and the data are safe either way."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
