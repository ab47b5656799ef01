"""The order of names that hold numbers."""

from __future__ import annotations

import re


def natural(name: str) -> list[tuple[int, int, str]]:
    """Returns a key that sorts numbers inside names by value: `frame_9` before `frame_10`; no two names are equal."""
    parts = re.split(r"(\d+)", name)
    keys = [(1, len(p.lstrip("0")), p.lstrip("0")) if p.isdigit() else (0, 0, p) for p in parts]
    return [*keys, (0, 0, name)]
