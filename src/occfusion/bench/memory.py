"""Peak memory of one call above what the process held before it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import torch

from occfusion.cpu.memory import return_memory

_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")
_RESET_PEAK = "5"
"""Writing 5 to `clear_refs` sets the peak resident size to the present one (Linux `proc(5)`)."""


def extra_memory_mb(call: Callable[[], object], device: torch.device) -> float | None:
    """Returns the peak of a call above the level before it, MB; None where the system does not tell.

    On a CPU: the resident size, after freed memory has been given back to the system so that it counts again
    when it is used again. Call it once before, so that compiling is not counted.
    """
    if device.type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        call()
        torch.cuda.synchronize()
        return (torch.cuda.max_memory_allocated() - before) / 1e6
    if sys.platform != "linux":
        return None
    return_memory()
    try:
        _CLEAR.write_text(_RESET_PEAK, encoding="ascii")
    except OSError:
        return None
    before = _status_kb("VmRSS")
    call()
    return (_status_kb("VmHWM") - before) * 1024 / 1e6


def _status_kb(key: str) -> int:
    for line in _STATUS.read_text(encoding="ascii").splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1])
    raise KeyError(f"{_STATUS} has no {key}")
