"""A lock between processes, kept by the operating system: a holder that is killed leaves none behind."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

if sys.platform != "win32":
    import fcntl


class Taken(Exception):
    """Another process holds the lock; the text says which."""


@contextlib.contextmanager
def only_one(path: Path, *, on_wait: Callable[[], None] | None = None, wait: bool = True) -> Iterator[None]:
    """Lets one process, and one thread of it, at a time into the block.

    The file exists while the lock is held. Where locks do not exist (Windows, some network disks) or the folder
    cannot be written, everybody is let in: what must be right without a lock is made right by other means.

    Args:
        path: the lock's file; its folder is made.
        on_wait: called once before waiting for another.
        wait: False: raise instead of waiting.

    Raises:
        Taken: another has it, and `wait` is False.
    """
    handle = _acquire(path, on_wait, wait)
    if handle is None:
        yield
        return
    try:
        os.ftruncate(handle, 0)
        os.write(handle, f"process {os.getpid()} on {socket.gethostname()}".encode())
        yield
    finally:
        # removed while it is held: whoever waited for this file finds out and makes another
        path.unlink(missing_ok=True)
        os.close(handle)


def _acquire(path: Path, on_wait: Callable[[], None] | None, wait: bool) -> int | None:
    """Returns the open, locked file; None where there are no locks."""
    if sys.platform == "win32":
        return None
    blocking = False
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:
            return None
        try:
            fcntl.flock(handle, fcntl.LOCK_EX if blocking else fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_still(path, handle):
                return handle
            os.close(handle)
        except BlockingIOError:
            holder = os.read(handle, 200).decode(errors="replace") or "another process"
            os.close(handle)
            if not wait:
                raise Taken(holder) from None
            if on_wait is not None and not blocking:
                on_wait()
            blocking = True
        except OSError:
            os.close(handle)
            return None


def _is_still(path: Path, handle: int) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False
