"""Where nothing is cached yet, a second process compiles kernels.

All of them while this one does something else, or the last one while this one compiles the others. The last one takes
a third of the time, as much as the second process needs for itself besides. Compiling holds the interpreter's lock, so
threads would not help. The second process leaves its work in the cache on disk, from which this one loads it. Whatever
goes wrong there costs time alone: what is not in the cache is compiled here.
"""

from __future__ import annotations

import atexit
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from occfusion.cpu.threads import usable_cores
from occfusion.splat.backends.numba.project import project_backward_part

PROGRAM = """
from occfusion.splat.backends.numba.project import compile_last
compile_last({of_covariances})
"""
"""Compiles the last kernel, for shapes that are covariances or for those that are not."""

COMPILES_AHEAD = "OCCFUSION_COMPILES_AHEAD"
"""Set in the environment of the second process, which starts no third one."""

_helpers: list[subprocess.Popen[bytes]] = []
"""The process that compiles, while it runs."""


def start(program: str) -> None:
    """Starts the second process where it would help: once, with a second core, with nothing in the cache.

    Args:
        program: what it runs, in Python.
    """
    kernel: Any = project_backward_part
    if _helpers or COMPILES_AHEAD in os.environ or kernel.signatures or is_cached(kernel):
        return
    if not sys.executable or usable_cores() < 2:
        return
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), COMPILES_AHEAD: "1"}
    _helpers.append(
        subprocess.Popen(
            [sys.executable, "-c", program], env=environment,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
    )  # fmt: skip


def wait() -> None:
    """Waits until the second process, if there is one, has finished."""
    while _helpers:
        _helpers.pop().wait()


def is_cached(kernel: Any) -> bool:
    """Returns whether the cache has an index of a kernel that is no older than its source.

    A guess: the index may be another processor's, or that of the other kind of shapes. True as well where compiled code
    cannot be cached, since a second process could leave its work nowhere.
    """
    function, folder = kernel.py_func, kernel.stats.cache_path
    if folder is None:
        return True
    source = Path(function.__code__.co_filename)
    indices = Path(folder).glob(f"{source.stem}.{function.__qualname__}-*.nbi")
    return any(index.stat().st_mtime >= source.stat().st_mtime for index in indices)


@atexit.register
def _stop() -> None:
    while _helpers:
        helper = _helpers.pop()
        helper.kill()
        helper.wait()
