"""A setting: a field of a dataclass with what it is, in a sentence, and what it may be."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Allowed:
    """What a setting may be.

    Attributes:
        low: least number.
        high: greatest number.
        choices: the values there are; empty: any.
        multiple: that a number is one of; None: any.
    """

    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    multiple: int | None = None

    def holds(self, value: object) -> bool:
        """Returns whether a value, or each of a list of them, is allowed; numbers have to be finite."""
        if isinstance(value, (list, tuple)):
            return all(self.holds(one) for one in value)
        if self.choices and value is not None:
            return value in self.choices
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            is_multiple = self.multiple is None or value % self.multiple == 0
            return math.isfinite(value) and self.low <= value <= self.high and is_multiple
        return True

    def in_words(self) -> str:
        """Returns what is allowed; nothing where everything is."""
        if self.choices:
            return " or ".join(part for part in (", ".join(self.choices[:-1]), self.choices[-1]) if part)
        several = f"a multiple of {self.multiple}, " if self.multiple else ""
        if math.isfinite(self.high):
            return f"{several}{_short(self.low)} to {_short(self.high)}"
        return f"{several}at least {_short(self.low)}" if math.isfinite(self.low) else ""


def setting(
    default: Any,
    text: str,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    choices: Sequence[str] = (),
    multiple: int | None = None,
    repr: bool = True,
) -> Any:
    """Returns a dataclass field: a setting with what it is, in a sentence, and what it may be.

    Args:
        default: its value where nothing is said.
        text: what it is.
        low: least number.
        high: greatest number.
        choices: the values there are.
        multiple: that a number has to be one of.
        repr: whether the record's `repr` has it.
    """
    metadata = {"text": text, "allowed": Allowed(low, high, tuple(choices), multiple)}
    if isinstance(default, (list, dict)):
        return dataclasses.field(default_factory=lambda: copy.copy(default), metadata=metadata)
    return dataclasses.field(default=default, repr=repr, metadata=metadata)


def with_default(kind: type, name: str, default: Any) -> Any:
    """Returns a field of a parent class with another default."""
    (field,) = (field for field in dataclasses.fields(kind) if field.name == name)
    return dataclasses.field(default=default, metadata=field.metadata)


def _short(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"
