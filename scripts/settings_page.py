"""The page of all settings, `docs/reference/settings.md`."""

from __future__ import annotations

import dataclasses
import re
import typing
from collections.abc import Mapping, Sequence
from typing import Any

from stated_settings import CONF, Setting, composed, first_sentence, flat, rows, value_in_words

from occfusion.settings.datasets import DATASETS
from occfusion.settings.priors import PRIORS
from occfusion.settings.schema import Named, Settings, VariantSettings

GENERATED = "*Written by `scripts/write_reference_pages.py`; change the code or `conf/`, and run it again.*"
PRESET_GROUPS = ("recipe", "variant", "speed", "refine", "sds", "evaluation", "prior", "prior_training")
"""Groups whose choices change settings that other groups hold, or their own."""
BASES = {"sd15_code": "prior=sd15"}
"""What a choice is compared with, where that is not the default."""
OWN_TABLE = {"sd15"}
"""Choices whose settings have a table of their own."""


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
    parts += [
        "",
        "## What a choice changes",
        "",
        "Against `python train.py`; `sd15_code` against `prior=sd15`.",
        "",
        *_changes(defaults),
    ]
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
