"""How much memory a block of code takes at its worst, whatever the process took before."""

from __future__ import annotations

import contextlib
import resource
from pathlib import Path
from types import TracebackType

_RESET_PEAK = "5"
"""Written to Linux's `clear_refs`: the peak starts again from what is in use now."""


class PeakMemory:
    """`megabytes` is the growth of resident memory at its peak inside the block.

    Where the peak cannot be reset, memory that the process took earlier hides as much growth.
    """

    def __enter__(self) -> PeakMemory:
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text(_RESET_PEAK)
        self._before = _peak()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.megabytes = _peak() - self._before


def _peak() -> float:
    status = Path("/proc/self/status")
    if status.is_file():
        return (
            next(int(line.split()[1]) for line in status.read_text().splitlines() if "VmHWM" in line) / 1024
        )
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
