"""Values that are kept until what they were computed from changes."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import torch


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
