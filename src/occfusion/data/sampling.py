"""Which frame a step sees: a function of the step alone, so that a resumed run goes on where it was."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count, islice
from typing import TypeVar

import numpy as np
from torch.utils.data import IterableDataset

from occfusion.types import Frame

AHEAD = 2
"""Frames made ready while a step runs: one hides the decoding, the second evens out slow files."""

T = TypeVar("T")


class StepSampler:
    """Each epoch visits all frames once, in an order drawn from the seed and the epoch."""

    def __init__(self, frames: int, seed: int) -> None:
        self._frames = frames
        self._seed = seed
        self._epoch = -1
        self._order: tuple[int, ...] = ()

    def position_at(self, step: int) -> int:
        """Returns the position, in 0..frames-1, of the frame that step `step` is given."""
        epoch, within = divmod(step, self._frames)
        if epoch != self._epoch:
            order = np.random.default_rng((self._seed, epoch)).permutation(self._frames)
            self._epoch, self._order = epoch, tuple(int(position) for position in order)
        return self._order[within]


def _never(_: object) -> bool:
    return False


def prefetched(
    read: Callable[[T], Frame], wanted: Iterable[T], is_kept: Callable[[T], bool] = _never
) -> Iterator[Frame]:
    """Yields the frames of `wanted` in order, made ahead by one thread (decoding releases the GIL).

    Args:
        read: gives a frame.
        wanted: which.
        is_kept: whether nothing has to be decoded for a frame. Those are made when they are asked for: what takes
            0.2 ms in one thread costs two that take turns 1.2.
    """
    rest = iter(wanted)
    reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="frames")
    pending: deque[tuple[T, Future[Frame] | None]] = deque()

    def begin(items: Iterable[T]) -> None:
        pending.extend((item, None if is_kept(item) else reader.submit(read, item)) for item in items)

    begin(islice(rest, AHEAD))
    try:
        while pending:
            item, future = pending.popleft()
            frame = read(item) if future is None else future.result()
            begin(islice(rest, 1))
            yield frame
    finally:
        reader.shutdown(wait=False, cancel_futures=True)


class StepStream(IterableDataset[Frame]):
    """Endless frames from a given step on."""

    def __init__(
        self,
        read: Callable[[int], Frame],
        sampler: StepSampler,
        first_step: Callable[[], int],
        share: Callable[[], tuple[int, int]] = lambda: (0, 1),
        is_kept: Callable[[int], bool] = _never,
    ) -> None:
        """Makes the stream.

        Args:
            read: gives the frame at a position.
            sampler: step to position.
            first_step: asked each time that iteration begins: the steps already taken.
            share: asked then as well: the number of this process, and of how many that take each step together.
                They are dealt one process's sequence of frames in turn.
            is_kept: as in `prefetched`.
        """
        self._read = read
        self._sampler = sampler
        self._first_step = first_step
        self._share = share
        self._is_kept = is_kept

    def __iter__(self) -> Iterator[Frame]:
        """Yields the frames of the steps to come."""
        rank, processes = self._share()
        drawn = count(self._first_step() * processes + rank, processes)
        return prefetched(self._read, map(self._sampler.position_at, drawn), self._is_kept)


def evenly(items: Sequence[T], wanted: int) -> list[T]:
    """Returns at most `wanted` of some items, evenly spread, the first and the last among them."""
    chosen = np.linspace(0, len(items) - 1, min(wanted, len(items))).round().astype(int)
    return [items[k] for k in chosen]


def spread(count: int, wanted: int) -> list[int]:
    """Returns at most `wanted` positions of `count`, each from the middle of an equal part."""
    wanted = min(count, wanted)
    return ((np.arange(wanted) + 0.5) * count / max(wanted, 1)).astype(int).tolist()
