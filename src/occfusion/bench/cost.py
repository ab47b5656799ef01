"""What a call costs: fair clocks for competitors in turn, and peak memory above what the process held before."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from occfusion.cpu.memory import return_memory

MAX_ROUNDS = 40
_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")
_RESET_PEAK = "5"
"""Writing 5 to `clear_refs` sets the peak resident size to the present one (Linux `proc(5)`)."""


@dataclass(frozen=True)
class Timing:
    """What repeating a call took, in milliseconds; processor time adds up all threads.

    Attributes:
        first: wall time of the very first call, compilation or reading its cache included.
        cpu_min: least processor time.
        cpu_median: median processor time.
        wall_min: least wall time.
        wall_median: median wall time.
        rounds: how often it was repeated.
    """

    first: float
    cpu_min: float
    cpu_median: float
    wall_min: float
    wall_median: float
    rounds: int


def interleaved(
    calls: Mapping[str, Callable[[], object]], seconds: float, least_rounds: int = 3
) -> dict[str, Timing]:
    """Returns the timing of each call, all of them measured in turn, round after round.

    What else the machine does then meets every competitor alike, so their ratios hold where absolute times do
    not.

    Args:
        calls: what to time, by name.
        seconds: wall time to spend on each call at most, beyond the least rounds.
        least_rounds: how often each call is repeated even when that takes longer; it is called twice before.
    """
    first = {name: _clocked(call)[1] for name, call in calls.items()}
    for call in calls.values():
        call()
    samples: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    end = time.monotonic() + seconds * len(calls)
    for done in range(MAX_ROUNDS):
        if done >= least_rounds and time.monotonic() > end:
            break
        for name, call in calls.items():
            samples[name].append(_clocked(call))
    return {name: _summary(first[name], samples[name]) for name in calls}


def _clocked(call: Callable[[], object]) -> tuple[float, float]:
    """Returns processor and wall milliseconds of one call, an accelerator's queued work included."""
    _synchronise()
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    _synchronise()
    return (time.process_time() - cpu) * 1e3, (time.perf_counter() - wall) * 1e3


def _synchronise() -> None:
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.synchronize()


def _summary(first: float, samples: list[tuple[float, float]]) -> Timing:
    cpu, wall = zip(*samples, strict=True)
    return Timing(first, min(cpu), statistics.median(cpu), min(wall), statistics.median(wall), len(samples))


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
