"""Peak memory of this process, on the host or the accelerator."""

from __future__ import annotations

import resource
import sys

import torch


def peak_memory_mb() -> float:
    """Returns the accelerator's peak in MB when one is in use, else the peak resident memory of the process."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        return torch.cuda.max_memory_allocated() / 1e6
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Linux counts kilobytes, macOS bytes
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6
