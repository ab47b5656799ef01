"""What code and `conf/` say of the settings: values, types, ranges, and a sentence on each."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from occfusion.errors import ConfigError
from occfusion.human.densify import Densification
from occfusion.settings import schema as schema

ROOT = Path(__file__).resolve().parents[1]
CONF = ROOT / "conf"


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


def described(docstring: str | None) -> dict[str, str]:
    """Returns the first sentence on each name below `Attributes:` or `Args:` of a Google docstring."""
    lines = inspect.cleandoc(docstring or "").splitlines()
    entries: dict[str, str] = {}
    name, inside, indent = "", False, 0
    for line in lines:
        if re.fullmatch(r"(Attributes|Args):", line):
            name, inside, indent = "", True, 0
        elif inside and line and not line.startswith(" "):
            inside = False
        elif inside and line.strip():
            indent = indent or len(line) - len(line.lstrip())
            match = re.match(r" +(\w+): +(.*)", line) if len(line) - len(line.lstrip()) == indent else None
            name = match[1] if match else name
            entries[name] = match[2] if match else f"{entries[name]} {line.strip()}"
    return {key: first_sentence(text) for key, text in entries.items()}


def commented(file: Path) -> dict[str, str]:
    """Returns the comment on each dotted key of a YAML file: behind it, or on the lines right above it."""
    found: dict[str, str] = {}
    parents: list[tuple[int, str]] = []
    above: list[str] = []
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines()):
        text = line.strip()
        if text.startswith("#"):
            above.append(text.lstrip("# "))
            continue
        match = re.match(r"( *)([\w@]+):(.*)", line)
        if match:
            depth = len(match[1])
            parents = [parent for parent in parents if parent[0] < depth]
            key = ".".join([name for _, name in parents] + [match[2]])
            parents.append((depth, match[2]))
            behind = re.search(r"\s#\s*(.*)", match[3])
            # the comment on top of a file is the file's
            mine = behind[1] if behind else " ".join(above) if number > len(above) else ""
            if mine:
                found[key] = first_sentence(mine)
        above = []
    return found


def first_sentence(text: str) -> str:
    """Returns a text up to its first full stop, without marks that a table has no use for."""
    sentence = re.split(r"(?<=[\w)\]`])(?<!e\.g)\. (?=[A-Z`\d])", " ".join(text.split()))[0].rstrip(".")
    sentence = re.sub(r"\s*\(docs/[\w/.-]+\)|[;:,]? *docs/[\w/.-]+( has [^.;]*)?", "", sentence)
    return sentence.replace("|", "or").replace("None", "null")


def stated_limits() -> dict[str, str]:
    """Returns what the checks of the settings allow, by key: they are run, and asked what they compare with."""
    limits: dict[str, str] = {}

    def in_range(key: str, value: float, low: float, high: float) -> None:
        limits[key] = (
            f"at least {_short(low)}" if high == float("inf") else f"{_short(low)} to {_short(high)}"
        )

    def among(key: str, value: str, allowed: Sequence[str]) -> None:
        limits[key] = ", ".join(allowed)

    with (
        patch.object(schema, "_check_range", in_range),
        patch.object(schema, "_check_in", among),
        initialize_config_dir(str(CONF), version_base="1.3"),
    ):
        schema.load_settings(compose("config", ["trainer.max_steps=1"]))
    for stage in ("optim", "refine"):
        for name, least in _densification_limits().items():
            limits[f"{stage}.densification.{name}"] = f"at least {least}"
    return limits


def _short(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


def _densification_limits() -> dict[str, int]:
    """Returns the least value that each threshold of the densification takes, by trying."""
    found = {}
    for field in dataclasses.fields(Densification):
        for least in (0, 1):
            try:
                Densification(**{field.name: least})
            except ConfigError:
                continue
            found[field.name] = least
            break
    return found


def kind_in_words(kind: Any) -> str:
    """Returns a type as a reader of a table would call it."""
    if isinstance(kind, str):  # of a signature
        words = kind.replace("Sequence[int | None]", "list of int").replace(
            "BetasSetting", "int | list | str | None"
        )
        words = re.sub(r"\s*\|\s*", " or ", words)
        words = words.replace("Path or str", "path").replace("str or Path", "path").replace("None", "null")
        return re.sub(r"Sequence\[(.*?)\]", r"list of \1", words).replace("Mapping[str, Any]", "group")
    arguments = typing.get_args(kind)
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return " or ".join("null" if one is type(None) else kind_in_words(one) for one in arguments)
    if typing.get_origin(kind) is list:
        return f"list of {kind_in_words(arguments[0])}"
    return str(getattr(kind, "__name__", kind))


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
