"""How kernels, of the rasteriser and of the perceptual metric, are compiled by numba, cached and spread over threads.

Kernels are plain serial loops that release the interpreter lock; a few Python threads run them on
interleaved parts of the work. Compared with numba's own `prange` that compiles in a third of the
time, needs no threading layer (so there is nothing to clash with the one of torch), and the parts,
hence every rounding, are the same for any number of threads.

What takes time to compile is left out: wrappers that nobody calls, branches for arguments that are None, and Python's
`min` and `max`, which are compiled for every kind of numbers; numpy's `minimum` and `maximum` are written in place.

Compiled code is cached beside these files, or where that is read-only in numba's user cache;
`NUMBA_CACHE_DIR` overrides both.
"""

from __future__ import annotations

import gc
import logging
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from threading import Lock
from typing import Any

import numba
from numba.core import event
from numba.extending import register_jitable

logger = logging.getLogger(__name__)

FAST_MATH = {"contract", "nsz"}
"""What may be rearranged: a product and a sum may be fused. Sums stay in the order they are written in, so that two
kernels that say the same thing round alike; infinities and NaN keep their meaning."""


class _Uncollected(event.Listener):
    """Pauses the garbage collector while numba compiles: it takes a sixth of the time and finds next to nothing."""

    def __init__(self) -> None:
        self._depth, self._was_enabled, self._lock = 0, False, Lock()

    def on_start(self, _: event.Event) -> None:
        with self._lock:  # kernels are called by several threads
            if self._depth == 0:
                self._was_enabled = gc.isenabled()
                gc.disable()
            self._depth += 1

    def on_end(self, _: event.Event) -> None:
        with self._lock:
            self._depth -= 1
            if self._depth == 0 and self._was_enabled:
                gc.enable()


event.register("numba:compile", _Uncollected())

OPTIONS: dict[str, Any] = {
    "nogil": True,
    "fastmath": FAST_MATH,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,  # which takes a tenth of the time, and nobody but Python calls a kernel
}


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the function, compiled on its first call (or loaded from the cache) to run without the GIL."""
    return _cached(function, {**OPTIONS, "boundscheck": False})


def serial(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the function, compiled as `kernel` does but with every rounding and error as Python has them."""
    return _cached(function, {"nogil": True})


def _cached(function: Callable[..., Any], options: dict[str, Any]) -> Callable[..., Any]:
    try:
        compiled: Callable[..., Any] = numba.njit(cache=True, **options)(function)
    except RuntimeError as error:  # no folder to cache in can be written
        logger.warning("compiled code cannot be cached (%s); set NUMBA_CACHE_DIR", error)
        compiled = numba.njit(**options)(function)
    return compiled


def inline(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the function, which stays Python's, and which kernels that call it compile into themselves.

    A function that Python could call in its compiled form would need a wrapper for that, which takes a tenth of all
    compilation.
    """
    helper: Callable[..., Any] = register_jitable(**OPTIONS, forceinline=True)(function)
    return helper


def step(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a helper that becomes text of the kernels that call it: for those called once, it compiles faster."""
    helper: Callable[..., Any] = numba.njit(inline="always")(function)
    return helper


def array_of(tensor: Any) -> Any:
    """Returns the numbers of a tensor as kernels take them; its memory is shared where it lies in one piece."""
    return tensor.detach().contiguous().numpy()


@lru_cache(maxsize=4)
def _pool(workers: int, process: int) -> ThreadPoolExecutor:
    """Returns the threads; `process` keeps a forked child from waiting for its parent's."""
    return ThreadPoolExecutor(workers, thread_name_prefix="occfusion-kernel")


def run_parts(function: Callable[..., None], *arguments: Any) -> None:
    """Runs `function(*arguments, part, parts)` for every part, as many as torch has threads."""
    import torch  # whoever compiles a kernel of their own needs none

    parts = torch.get_num_threads()
    if parts <= 1:
        function(*arguments, 0, 1)
        return
    pool = _pool(parts - 1, os.getpid())
    others = [pool.submit(function, *arguments, part, parts) for part in range(1, parts)]
    try:
        function(*arguments, 0, parts)
    finally:
        wait(others)
    for other in others:
        other.result()
