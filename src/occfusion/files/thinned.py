"""Reading a part of a large pickle in bounded memory: what is not wanted is dropped as soon as it is complete.

A pickle can be read from its beginning to its end alone, and anything in it may be named again later, so that an
ordinary reader keeps everything. Here the tables (dicts) inside lists are offered to the caller while their list is
being built; those that he drops are forgotten with all that they hold. Where something forgotten is named again, the
file is read a second time and that is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from occfusion.errors import DataError
from occfusion.files.inert import DtypeRecord, Global, Inert
from occfusion.files.unpickle import DataUnpickler, explained, load_pickle, size_within

MAX_BYTES = 16 << 30
"""Largest file that is read in parts: 300 000 annotated pictures of OcMotion take about 0.5 GB."""

Thin = Callable[[dict[Any, Any]], object | None]

_KEPT_OF_A_LIST = 128
"""Objects at the beginning of each list that are kept: what its tables have in common is written with the first."""

_PASSES = 2
"""The second pass keeps whatever the first one missed; more are needed only by files made to need them."""


def load_thinned(path: Path | str, thin: Thin) -> Any:
    """Returns the data of a pickle file with tables inside lists dropped; executes nothing.

    Args:
        path: the file; its content is never in memory as a whole.
        thin: given a table, returns what is to stand in its place (plain data, for many tables the same object), or
            None to keep it. Text and numbers in the table are ready; arrays in it cannot be looked at yet.

    Raises:
        DataError: as `load_pickle`.
    """
    path = Path(path)
    needed: frozenset[int] = frozenset()
    try:
        size = size_within(path, MAX_BYTES)
        for _ in range(_PASSES):
            with path.open("rb") as file:
                machine = _ThinningUnpickler(_Bounded(file, size), size, thin, needed)
                try:
                    content = explained(machine.load, str(path))
                except DataError:
                    if not machine.missed:  # else it failed because something had been forgotten
                        raise
                else:
                    if not machine.missed:
                        return content
            needed |= machine.missed
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error}).") from error
    return load_pickle(path)


class _Bounded:
    """A file that reserves no memory for what lies beyond its end, whatever length is asked for."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file, self._left = file, size

    def read(self, count: int) -> bytes:
        part = self._file.read(max(min(count, self._left), 0))
        self._left -= len(part)
        return part

    def readline(self) -> bytes:
        line = self._file.readline()
        self._left -= len(line)
        return line


class _Forgotten(Inert):
    """Stands for something that was dropped and is named again."""


class _Memo(dict[int, Any]):
    """The pickle's numbered objects, of which some have been forgotten; counts as if none had."""

    def __init__(self) -> None:
        super().__init__()
        self.fresh: list[int] = []  # numbers given since something was dropped or kept
        self.missed: set[int] = set()
        self._count, self._last = 0, -1

    def __setitem__(self, number: int, value: Any) -> None:
        if number > self._last:
            self._count, self._last = self._count + 1, number
        self.fresh.append(number)
        super().__setitem__(number, value)

    def __len__(self) -> int:  # the next number of a pickle that does not number explicitly
        return self._count

    def __missing__(self, number: int) -> Any:
        if number > self._last:
            raise KeyError(number)
        self.missed.add(number)
        return _Forgotten()


class _ThinningUnpickler(DataUnpickler):
    def __init__(self, stream: _Bounded, size: int, thin: Thin, needed: frozenset[int]) -> None:
        super().__init__(stream, size)
        self.memo = _Memo()
        self._thin, self._needed = thin, needed
        self._words: set[str] = set()  # keys of dropped tables: those that follow name them again

    @property
    def missed(self) -> set[int]:
        """Numbers of objects that were named again after they had been forgotten."""
        return self.memo.missed

    def extend(self, target: Any, items: list[Any]) -> None:
        """Appends items to a list, or what is to stand in their place."""
        tables = [item for item in items if isinstance(item, dict)]
        if tables:
            stands = [self._thin(item) if isinstance(item, dict) else None for item in items]
            if all(stand is not None for stand in stands):
                self._forget(tables, 0 if target else _KEPT_OF_A_LIST)
            self.memo.fresh.clear()
            items = [item if stand is None else stand for item, stand in zip(items, stands, strict=True)]
        super().extend(target, items)

    def _forget(self, tables: list[dict[Any, Any]], kept: int) -> None:
        """Drops from the memo what was read since the last decision, but for its beginning and common words."""
        for table in tables:
            self._learn(table)
        building = {id(item) for level in (*self.metastack, self.stack) for item in level}
        for number in self.memo.fresh[kept:]:
            value = self.memo.get(number)
            if number not in self._needed and id(value) not in building and not self._is_common(value):
                self.memo.pop(number, None)

    def _learn(self, table: dict[Any, Any]) -> None:
        for key, value in table.items():
            if isinstance(key, str):
                self._words.add(key)
            if isinstance(value, dict) and value is not table:
                self._words.update(word for word in value if isinstance(word, str))

    def _is_common(self, value: Any) -> bool:
        if isinstance(value, (str, bytes)):  # Python has one object for each single character
            return len(value) <= 1 or value in self._words
        return isinstance(value, (Global, DtypeRecord))
