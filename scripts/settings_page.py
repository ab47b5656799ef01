"""The page of all settings, `docs/reference/settings.md`: what code and `conf/` say of each."""

from __future__ import annotations

import dataclasses
import functools
import re
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from occfusion.errors import ConfigError
from occfusion.fields import type_in_words
from occfusion.settings.datasets import DATASETS
from occfusion.settings.priors import PRIORS
from occfusion.settings.schema import Named, Settings, VariantSettings

CONF = Path(__file__).resolve().parents[1] / "conf"
GENERATED = "*Written by `scripts/write_reference_pages.py`; change the code or `conf/`, and run it again.*"
PRESET_GROUPS = ("recipe", "variant", "speed", "refine", "sds", "evaluation", "prior", "prior_training")
"""Groups whose choices change settings that other groups hold, or their own."""
BASES = {"sd15_code": "prior=sd15"}
"""What a choice is compared with, where that is not the default."""
OWN_TABLE = {"sd15"}
"""Choices whose settings have a table of their own."""


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
        # left out: the name of a choice, and a group that is not asked for
        elif field.name != "name" and value is not dataclasses.MISSING:
            if not field.metadata.get("text"):
                raise ConfigError(f"{key}: a setting without a sentence")
            allowed, kind = field.metadata["allowed"].in_words(), type_in_words(hints[field.name])
            text = " ".join(field.metadata["text"].split()).replace("|", "or")
            own.append(Setting(key, kind, value_in_words(value), allowed, text))
    return own + inner


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


def settings_page() -> str:
    """Returns the page of all settings."""
    defaults = composed()
    parts = [
        "# Settings",
        "",
        GENERATED,
        "",
        "Defaults are those of `python train.py`. What each choice changes is [below](#what-a-choice-changes).",
        "Types, names and ranges are checked before any work starts.",
        "",
        "## Choices",
        "",
        *_choices(defaults),
    ]
    plain = {key: value for key, value in defaults.items() if not isinstance(value, Mapping)}
    parts += ["", "## Of the run", "", *_table(rows("", Settings, plain))]
    for group, record in typing.get_type_hints(Settings).items():
        if not dataclasses.is_dataclass(record) or group == "dataset":
            continue
        if not issubclass(record, (Named, VariantSettings)):  # of those nothing but the choice is set
            parts += ["", f"## `{group}`", "", *_table(rows(group, record, defaults[group]))]
    for name, prior in PRIORS.items():
        own = composed(f"prior={name}")["prior"]
        parts += ["", f"## `prior={name}`", "", *_table(rows("prior", prior, own))]
    for name, dataset in DATASETS.items():
        found = rows("dataset", dataset, composed(f"dataset={name}")["dataset"])
        occlusion = [row for row in found if row.key.startswith("dataset.occlusion.")]
        shown = [row for row in found if row not in occlusion or row.key.endswith(".kind")]
        parts += ["", f"## `dataset={name}`", "", *_table(shown)]
    text = "Of every data set; `until` and the protocols' strips are ZJU-MoCap's."
    occlusion = rows("dataset", DATASETS["zju"], composed("dataset=zju")["dataset"])
    parts += ["", "## `dataset.occlusion`", "", text, ""]
    parts += _table([row for row in occlusion if row.key.startswith("dataset.occlusion.")])
    against = "Against `python train.py`; `sd15_code` against `prior=sd15`."
    parts += ["", "## What a choice changes", "", against, "", *_changes(defaults)]
    return "\n".join(parts) + "\n"


def _choices(defaults: Mapping[str, Any]) -> list[str]:
    lines = ["| group | choices | default | what it chooses |", "|---|---|---|---|"]
    text = (CONF / "config.yaml").read_text(encoding="utf-8")
    for group, default, comment in re.findall(r"^  - (\w+): +(\w+) *#? *(.*)$", text, re.MULTILINE):
        names = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
        lines.append(f"| `{group}` | {', '.join(names)} | `{default}` | {first_sentence(comment)} |")
    return lines


def _table(found: Sequence[Setting]) -> list[str]:
    """Returns a table."""
    lines = ["| setting | type | default | allowed | what it is |", "|---|---|---|---|---|"]
    lines += [
        f"| `{row.key}` | {row.kind} | `{row.default}` | {row.allowed} | {row.sentence} |" for row in found
    ]
    return lines


def _changes(defaults: Mapping[str, Any]) -> list[str]:
    own = dict(flat(defaults))
    lines = ["| choice | changes |", "|---|---|"]
    for group in PRESET_GROUPS:
        for file in sorted((CONF / group).glob("*.yaml")):
            if file.stem in OWN_TABLE:
                continue
            now = dict(flat(composed(f"{group}={file.stem}")))
            before = dict(flat(composed(BASES[file.stem]))) if file.stem in BASES else own
            changed = [
                f"`{key}={value_in_words(value)}`"
                for key, value in now.items()
                if before.get(key, "") != value and key != f"{group}.name" and not key.startswith("variant.")
            ]
            if changed:
                lines.append(f"| `{group}={file.stem}` | {', '.join(changed)} |")
    return lines
