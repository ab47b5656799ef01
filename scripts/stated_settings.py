"""What code and `conf/` say of the settings: values, types, ranges, and a sentence on each."""

from __future__ import annotations

import dataclasses
import functools
import re
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from occfusion.errors import ConfigError
from occfusion.fields import type_in_words
from occfusion.settings.schema import Settings

ROOT = Path(__file__).resolve().parents[1]
CONF = ROOT / "conf"


@dataclasses.dataclass(frozen=True)
class Setting:
    """One row: key, type, default, what is allowed, and a sentence."""

    key: str
    kind: str
    default: str
    allowed: str
    sentence: str


@functools.cache
def composed(*overrides: str) -> dict[str, Any]:
    """Returns the configuration that a command line composes, as plain data."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return typing.cast("dict[str, Any]", OmegaConf.to_container(compose("config", list(overrides))))


def flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields dotted keys and values of nested settings."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def rows(group: str, record: type, values: Mapping[str, Any]) -> list[Setting]:
    """Returns the settings of a record: first its own, then those of the records in it.

    Args:
        group: dotted name of the record; empty for the settings of the run.
        record: a dataclass.
        values: as `conf/` composes them; what is not there has the default of the code.

    Raises:
        ConfigError: a setting has no sentence.
    """
    hints, own, inner = typing.get_type_hints(record), [], []
    for field in dataclasses.fields(record):
        key = f"{group}.{field.name}" if group else field.name
        value = values.get(field.name, field.default)
        if dataclasses.is_dataclass(hints[field.name]) and isinstance(value, Mapping):
            inner += rows(key, hints[field.name], value)
        elif (
            field.name != "name" and value is not dataclasses.MISSING
        ):  # a choice, or a group that is not asked for
            if not field.metadata.get("text"):
                raise ConfigError(f"{key}: a setting without a sentence")
            allowed, kind = field.metadata["allowed"].in_words(), type_in_words(hints[field.name])
            text = " ".join(field.metadata["text"].split()).replace("|", "or")
            own.append(Setting(key, kind, value_in_words(value), allowed, text))
    return own + inner


def stated_limits() -> dict[str, str]:
    """Returns what the settings of `python train.py` may be, by key."""
    values = composed()
    groups = {group: value for group, value in values.items() if isinstance(value, Mapping)}
    hints = typing.get_type_hints(Settings)
    found = rows("", Settings, {key: value for key, value in values.items() if key not in groups})
    for group, value in groups.items():
        if group not in ("dataset", "prior"):
            found += rows(group, hints[group], value)
    return {row.key: row.allowed for row in found}


def first_sentence(text: str) -> str:
    """Returns a text up to its first full stop, without marks that a table has no use for."""
    sentence = re.split(r"(?<=[\w)\]`])(?<!e\.g)\. (?=[A-Z`\d])", " ".join(text.split()))[0].rstrip(".")
    sentence = re.sub(r"\s*\(docs/[\w/.-]+\)|[;:,]? *docs/[\w/.-]+( has [^.;]*)?", "", sentence)
    return sentence.replace("|", "or").replace("None", "null")


def value_in_words(value: Any) -> str:
    """Returns a value as it is written on a command line."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return "[" + ",".join(value_in_words(one) for one in value) + "]"
    return str(value)
