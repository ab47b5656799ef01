"""Threads of two kinds on the same cores: those of torch (OpenMP) and those of the compiled rasteriser."""

from __future__ import annotations

import os

SPINS = "10000"
"""Turns for which an idle thread of GNU OpenMP watches for new work before it sleeps, about 0.1 ms. Its own choice,
300000, keeps a core busy for milliseconds after every operation of torch, and whatever else runs in parallel waits:
two threads then render no faster than one. Sleeping at once costs more than it gives, in torch's own operations."""


def share_cores() -> None:
    """Lets idle threads of torch leave their cores soon, unless the user has said how long they are to wait.

    GNU OpenMP reads this once, when torch is imported; later it has no effect on this process.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)


def usable_cores() -> int:
    """Returns how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
