"""Damaged copies of a file: bytes changed, parts cut or repeated, code spliced in, values exchanged."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

GADGETS = (
    b"cos\nsystem\n(S'touch RAN'\ntR.",
    b'c__builtin__\neval\n(S\'open("RAN","w")\'\ntR.',
    b"\x80\x04\x8c\x08builtins\x8c\x04exec\x93\x8c\x13open('RAN', 'w').write\x85R.",
    b"cbuiltins\ngetattr\n(cos\nsystem\nS'__call__'\ntR.",
)
"""Pickles that would make the file RAN."""

STRANGE = (
    None, True, -1, 10**30, float("nan"), float("inf"), "", "x" * 5000, "../../etc/passwd", b"\0" * 9, [], {}, (),
    [[]], {"ims": 3}, {1: 2}, np.zeros(0), np.zeros((3, 3)), np.full((3, 3), np.nan), np.full((4, 4), 1e300),
    np.array("text"), np.array([None, {}], dtype=object), np.zeros((2, 3, 4, 5)), np.int64(7), 1j, "\ud800",
)  # fmt: skip


def mutated_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    """One random damage to a file's bytes."""
    data = bytearray(content)
    place = int(rng.integers(len(data)))
    match int(rng.integers(7)):
        case 0:  # a few bits
            for where in rng.integers(len(data), size=int(rng.integers(1, 9))):
                data[where] ^= 1 << int(rng.integers(8))
        case 1:  # cut short
            del data[place:]
        case 2:  # a part lost
            del data[place : place + int(rng.integers(1, 65))]
        case 3:  # a part twice
            data[place:place] = data[place : place + int(rng.integers(1, 65))]
        case 4:  # noise
            data[place : place + 8] = rng.bytes(8)
        case 5:  # extreme lengths
            data[place : place + 4] = [b"\xff\xff\xff\x7f", b"\xff\xff\xff\xff", b"\0\0\0\0"][
                int(rng.integers(3))
            ]
        case _:  # code in the middle
            data[place:place] = GADGETS[int(rng.integers(len(GADGETS)))]
    return bytes(data)


def mutated_value(content: Any, rng: np.random.Generator, json_only: bool = False) -> Any:
    """A copy of nested containers in which one value, key or entry is exchanged, dropped or doubled."""
    content = copy.deepcopy(content)
    spots: list[tuple[Any, Any]] = []
    _collect(content, spots)
    holder, key = spots[int(rng.integers(len(spots)))]
    action = int(rng.integers(4))
    if action == 0 and isinstance(holder, dict):
        del holder[key]
    elif action == 1 and isinstance(holder, list):
        holder.append(copy.deepcopy(holder[key]))
    elif action == 2 and isinstance(holder[key], np.ndarray) and holder[key].size:
        array = np.array(holder[key], dtype=float)
        array.reshape(-1)[int(rng.integers(array.size))] = rng.choice([np.nan, np.inf, -1e30, 0.0, 1e6])
        holder[key] = array
    else:
        strange = [v for v in STRANGE if _is_json(v)] if json_only else STRANGE
        holder[key] = strange[int(rng.integers(len(strange)))]
    return content


def _collect(value: Any, spots: list[tuple[Any, Any]]) -> None:
    if isinstance(value, dict):
        keys = list(value)
    elif isinstance(value, list):
        keys = list(range(len(value)))
    else:
        return
    for key in keys:
        spots.append((value, key))
        _collect(value[key], spots)


def _is_json(value: Any) -> bool:
    return value is None or (isinstance(value, (bool, int, float, str, list, dict)) and value != {1: 2})
