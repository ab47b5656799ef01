"""Threads of several kinds on the same cores: of torch (OpenMP), of NumPy's linear algebra, of our own kernels."""

from __future__ import annotations

import os

SPINS = "10000"
"""Turns for which an idle thread of GNU OpenMP watches for new work before it sleeps, about 0.1 ms. Its own choice,
300000, keeps a core busy for milliseconds after every operation of torch, and whatever else runs in parallel waits:
two threads then render no faster than one. Sleeping at once costs more than it gives, in torch's own operations."""

LINEAR_ALGEBRA = "1"
"""Threads of OpenBLAS, which NumPy and SciPy bring. What is solved here is small: a second thread that waits for its
part takes the time of whatever else could run, and made the alignment of poses a fifth slower."""


def share_cores() -> None:
    """Lets idle threads of torch leave their cores soon, and NumPy have one, unless the user has said otherwise.

    GNU OpenMP and OpenBLAS read this once, when torch and NumPy are imported; later it has no effect on this process.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", LINEAR_ALGEBRA)


def usable_cores() -> int:
    """Returns how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
