"""Memory of this process: its peak, on the host or the accelerator, and giving back what is free."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch

MAP_FROM = -3
"""M_MMAP_THRESHOLD of glibc's `mallopt`."""

APART, USUAL = 8 << 20, 32 << 20
"""Bytes from which blocks are apart; and otherwise: what glibc comes to by itself where large blocks are freed."""


def peak_memory_mb() -> float:
    """Returns the accelerator's peak in MB when one is in use, else the peak resident memory of the process."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        allocated = torch.cuda.max_memory_allocated()
        if allocated:  # with `trainer.accelerator=cpu` it may be asked for its name alone
            return allocated / 1e6
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Linux counts kilobytes, macOS bytes
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def return_memory() -> None:
    """Collects what nothing refers to, and gives freed memory back to the system."""
    gc.collect()  # trainers refer to their stages and those to them
    trim_memory()


def trim_memory() -> None:
    """Asks the C library to return freed memory to the system, where it can."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's
        if trim is not None:
            trim(0)


@contextmanager
def large_blocks_apart() -> Iterator[None]:
    """Keeps large blocks of memory out of the heap, where the C library can and the user has not said otherwise.

    Freed, they are the system's at once. In the heap, blocks of ever other sizes leave holes that nothing fits into.
    """
    change = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if change is None or "MALLOC_MMAP_THRESHOLD_" in os.environ:
        yield
        return
    change(MAP_FROM, APART)
    try:
        yield
    finally:
        change(MAP_FROM, USUAL)
