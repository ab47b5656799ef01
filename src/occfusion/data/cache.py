"""Decoded frames kept in memory up to a bound."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Generic, Protocol, TypeVar


class Sized(Protocol):
    """Something that knows how many bytes it takes."""

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays."""


T = TypeVar("T", bound=Sized)


class BoundedCache(Generic[T]):
    """Keeps what is made until the bound is reached, then keeps what it has.

    Nothing is ever thrown out: training visits all frames in turn, and throwing out the oldest would then
    throw out exactly those that come next.
    """

    def __init__(self, max_bytes: int) -> None:
        self._left = max_bytes
        self._kept: dict[object, T] = {}
        self._lock = Lock()

    def get(self, key: object, make: Callable[[], T]) -> T:
        """Returns what is kept under `key`, or makes it and keeps it if it still fits."""
        found = self._kept.get(key)
        if found is None:
            found = make()
            with self._lock:
                if key not in self._kept and found.nbytes <= self._left:
                    self._kept[key] = found
                    self._left -= found.nbytes
        return found

    def __len__(self) -> int:
        """Number of items kept."""
        return len(self._kept)
