"""Records of settings from mappings: of the right names and types, and in their ranges."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

from occfusion.errors import ConfigError
from occfusion.fields.setting import Allowed

T = TypeVar("T")


def read_record(kind: type[T], given: Mapping[str, Any], group: str = "", base: T | None = None) -> T:
    """Returns settings as a mapping gives them, each of its type and in its range.

    Args:
        kind: a dataclass.
        given: values by name; a mapping, or a record, where the field is a dataclass itself.
        group: dotted name of the whole, for messages.
        base: what holds where nothing is given; None: the defaults.

    Raises:
        ConfigError: an unknown name, a wrong type, or a value that is not allowed.
    """
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    hints, values = typing.get_type_hints(kind), {}
    for name, value in given.items():
        key = f"{group}.{name}" if group else str(name)
        if name not in fields:
            raise ConfigError(f"setting {key}: unknown; {nearest(str(name), fields)}")
        inner = None if base is None else getattr(base, name)
        factory = fields[name].default_factory
        if inner is None and callable(factory):
            inner = factory()
        values[name] = _converted(hints[name], value, key, inner)
        check_allowed(key, values[name], fields[name])
    return kind(**values) if base is None else dataclasses.replace(base, **values)  # type: ignore[type-var]


def check_fields(record: Any, group: str) -> None:
    """Refuses a record that was made in Python with a value of another type, or one that is not allowed.

    Raises:
        ConfigError: naming the setting.
    """
    hints = typing.get_type_hints(type(record))
    for field in dataclasses.fields(record):
        key, value = f"{group}.{field.name}", getattr(record, field.name)
        _converted(hints[field.name], value, key)
        check_allowed(key, value, field)


def check_allowed(key: str, value: object, field: dataclasses.Field[Any]) -> None:
    """Refuses a value that a field does not allow.

    Raises:
        ConfigError: with what it does allow.
    """
    allowed: Allowed | None = field.metadata.get("allowed")
    if allowed is not None and not allowed.holds(value):
        words = allowed.in_words() or "a finite number"
        raise ConfigError(f"setting {key}={value!r}: must be {words}")


def check_choice(key: str, value: str, choices: Sequence[str]) -> None:
    """Refuses what is not among the choices.

    Raises:
        ConfigError: with the choices.
    """
    if value not in choices:
        raise ConfigError(f"setting {key}: {value!r} is not one of {', '.join(choices)}")


def nearest(name: str, known: Iterable[str], *, few: bool = False) -> str:
    """Returns a hint, in words: the known name that is most like another; else all of them, or where they stand."""
    names = list(known)
    others = "see docs/reference/settings.md" if few else f"there are {', '.join(names)}"
    close = difflib.get_close_matches(name, names, n=1)
    return f"did you mean {close[0]}?" if close else others


def _converted(kind: Any, value: Any, key: str, base: Any = None) -> Any:
    """Returns a value as the type of its field has it: a whole number may stand for any."""
    options = typing.get_args(kind)
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        if value is None and type(None) in options:
            return None
        exact = [one for one in options if one is type(value)]
        for option in exact or [one for one in options if one is not type(None)]:
            try:
                return _converted(option, value, key, base)
            except ConfigError:
                if len(options) - (type(None) in options) == 1:
                    raise
    elif kind is Any:
        return value
    elif dataclasses.is_dataclass(kind):
        if isinstance(value, kind):  # type: ignore[arg-type]
            return value
        if isinstance(value, Mapping):
            return read_record(kind, value, key, base)  # type: ignore[arg-type]
        if hasattr(kind, "parse"):
            return kind.parse(value)
    elif typing.get_origin(kind) is list and isinstance(value, (list, tuple)):
        return [_converted(options[0], one, key) for one in value]
    elif typing.get_origin(kind) is dict and isinstance(value, Mapping):
        return {str(name): _converted(options[1], one, f"{key}.{name}") for name, one in value.items()}
    elif isinstance(value, bool) or kind is bool:
        if kind is type(value):
            return value
    elif (kind is float and isinstance(value, (int, float))) or (kind is not float and type(value) is kind):
        return float(value) if kind is float else value
    raise ConfigError(f"setting {key}={value!r}: expected {type_in_words(kind)}")


def type_in_words(kind: Any) -> str:
    """Returns a type as a reader of a table would call it."""
    options = typing.get_args(kind)
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return " or ".join("null" if one is type(None) else type_in_words(one) for one in options)
    if typing.get_origin(kind) is list:
        return f"list of {type_in_words(options[0]).removesuffix(' or null')}"
    if kind is Any:
        return "any"
    return "group" if dataclasses.is_dataclass(kind) else str(getattr(kind, "__name__", kind))
