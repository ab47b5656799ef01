"""Independent pieces of work on the cores of one machine."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

AHEAD = 3
"""Items a worker that are taken ahead: while one takes six times as long as the others, these go on."""

Item = TypeVar("Item")
Result = TypeVar("Result")


def threaded_map(function: Callable[[Item], Result], items: Iterable[Item], workers: int) -> Iterator[Result]:
    """Yields the function's results in the order of the items, several being worked on at a time.

    Each worker computes with one thread of torch, so that a result does not depend on how many there are. Items are
    taken as they are needed, a few ahead. To be exhausted: threads of torch are given back at its end.

    Args:
        function: spends its time outside the interpreter's lock, in torch or compiled kernels.
        items: what to call it with.
        workers: threads; with 1 everything happens in the caller's, and with the caller's threads of torch.
    """
    if workers <= 1:
        yield from map(function, items)
        return
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(workers, thread_name_prefix="occfusion-worker") as pool:
            pending: deque[Future[Result]] = deque()
            for item in items:
                pending.append(pool.submit(_with_one_thread, function, item))
                if len(pending) > AHEAD * workers:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
    finally:
        torch.set_num_threads(threads)


def _with_one_thread(function: Callable[[Item], Result], item: Item) -> Result:
    torch.set_num_threads(1)  # a setting of the thread
    return function(item)
