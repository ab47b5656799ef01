"""Values that are kept until what they were computed from changes."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import torch
from torch import Tensor


class Unchanged:
    """A key for what tensors hold at present: equal to another one of the same tensors, not written to in between.

    It keeps them alive. A tensor that took the place of a freed one in memory would have its number, too.
    """

    def __init__(self, *tensors: Tensor) -> None:
        self._tensors, self._versions = tensors, [tensor._version for tensor in tensors]

    def __eq__(self, other: object) -> bool:
        """Tells whether all tensors are the very same and as they were."""
        return (
            isinstance(other, Unchanged)
            and self._versions == other._versions
            and len(self._tensors) == len(other._tensors)
            and all(a is b for a, b in zip(self._tensors, other._tensors, strict=True))
        )

    def __hash__(self) -> int:
        """Equal keys have equal ones."""
        return hash(tuple(map(id, self._tensors)))


class Memo:
    """The last value of each name, with the key that it belongs to."""

    def __init__(self) -> None:
        self._held: dict[str, tuple[Hashable, Any]] = {}

    def get(self, name: str, key: Hashable, make: Callable[[], Any]) -> Any:
        """Returns what `make` gives, computed anew only when `key` has changed; never part of a graph."""
        held = self._held.get(name)
        if held is None or held[0] != key:
            # inference tensors could not be used in training afterwards
            with torch.inference_mode(False), torch.no_grad():
                held = self._held[name] = (key, make())
        return held[1]

    def clear(self) -> None:
        """Forgets everything."""
        self._held.clear()
