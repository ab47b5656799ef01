"""Memory of this process: its peak, on the host or the accelerator, and giving back what is free."""

from __future__ import annotations

import ctypes
import gc
import resource
import sys

import torch


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
