"""The page of all settings, `docs/reference/settings.md`."""

from __future__ import annotations

import dataclasses
import inspect
import re
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hydra.utils import get_object
from stated_settings import (
    CONF,
    commented,
    composed,
    described,
    first_sentence,
    flat,
    kind_in_words,
    stated_limits,
    value_in_words,
)

from occfusion.data.occlusion import OcclusionSettings
from occfusion.errors import ConfigError
from occfusion.inpaint.embedded_inpainter import EmbeddedInpainterSettings
from occfusion.inpaint.sd15_inpainter import Sd15InpaintSettings
from occfusion.priors.embedded.silhouette_prior import EmbeddedSettings
from occfusion.priors.sd15.score_prior import Sd15ScoreSettings
from occfusion.priors.sd15.settings import Sd15Settings
from occfusion.settings import schema as schema

GENERATED = "*Written by `scripts/write_reference_pages.py`; change the code or `conf/`, and run it again.*"
CHOICES_ALONE = (schema.Named, schema.VariantSettings)
"""Groups of which nothing but the choice is set."""
PRIOR_RECORDS: dict[str, dict[str, type]] = {
    "embedded": {"prior": EmbeddedSettings, "prior.inpaint": EmbeddedInpainterSettings},
    "sd15": {
        "prior": Sd15Settings,
        "prior.score": Sd15ScoreSettings,
        "prior.inpaint": Sd15InpaintSettings,
    },
}
DATASETS = ("synthetic", "zju", "ocmotion", "video")
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


def settings_page() -> str:
    """Returns the page of all settings."""
    limits, defaults = stated_limits(), composed()
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
    top = commented(CONF / "config.yaml")
    hints = typing.get_type_hints(schema.Settings)
    plain = [
        Setting(key, kind_in_words(hints[key]), value_in_words(value), limits.get(key, ""), top.get(key, ""))
        for key, value in defaults.items()
        if not isinstance(value, Mapping)
    ]
    parts += ["", "## Of the run", "", *_table(plain)]
    for group, record in hints.items():
        if dataclasses.is_dataclass(record) and record not in CHOICES_ALONE:
            rows = _of_record(group, record, defaults[group], limits)
            parts += ["", f"## `{group}`", "", *_table(rows)]
    for name, records in PRIOR_RECORDS.items():
        parts += ["", f"## `prior={name}`", "", *_table(_of_prior(name, records))]
    for name in DATASETS:
        parts += ["", f"## `dataset={name}`", "", *_table(_of_dataset(name))]
    text = "Of every data set; `until` and the protocols' strips are ZJU-MoCap's."
    parts += ["", "## `dataset.occlusion`", "", text, "", *_table(_of_occlusion("zju"))]
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


def _of_record(
    group: str, record: type, values: Mapping[str, Any], limits: Mapping[str, str]
) -> list[Setting]:
    """Returns the rows of a dataclass; what is in it under a name of its own comes after."""
    comments: dict[str, str] = commented(CONF / "optim" / "default.yaml") if group == "refine" else {}
    for file in sorted((CONF / group.split(".")[0]).glob("*.yaml"), key=lambda path: path.stem == "default"):
        comments |= commented(file)
    if group == "optim":
        comments |= {f"sds.{key}": text for key, text in commented(CONF / "sds" / "default.yaml").items()}
    return list(_rows(group, "", record, values, limits, comments))


def _rows(
    group: str,
    inner: str,
    record: type,
    values: Mapping[str, Any],
    limits: Mapping[str, str],
    comments: Mapping[str, str],
) -> Iterator[Setting]:
    hints = typing.get_type_hints(record)
    sentences: dict[str, str] = {}
    for base in reversed(record.__mro__):
        sentences |= described(base.__doc__)
    later = []
    given = dict(values)
    for field in dataclasses.fields(record):  # what `conf/` leaves to the code
        given.setdefault(field.name, field.default)
    for name, value in given.items():
        if name == "name":  # the choice of the group
            continue
        kind, path = hints[name], f"{inner}{name}"
        if isinstance(value, Mapping):
            later.append((f"{path}.", kind, value))
            continue
        key = f"{group}.{path}"
        sentence = sentences.get(name) or comments.get(path, "")
        yield Setting(key, kind_in_words(kind), value_in_words(value), limits.get(key, ""), sentence)
    for path, kind, value in later:
        yield from _rows(group, path, kind, value, limits, comments)


def _of_prior(name: str, records: Mapping[str, type]) -> list[Setting]:
    values = composed(f"prior={name}")["prior"]
    rows = []
    for group, record in records.items():
        inner = group.removeprefix("prior").removeprefix(".")
        own = values[inner] if inner else {k: v for k, v in values.items() if not isinstance(v, Mapping)}
        comments = commented(CONF / "prior" / f"{name}.yaml")
        comments = (
            {key.removeprefix(f"{inner}."): text for key, text in comments.items()} if inner else comments
        )
        rows += list(_rows(group, "", record, own, {}, comments))
    return rows


def _of_dataset(name: str) -> list[Setting]:
    values = dict(composed(f"dataset={name}")["dataset"])
    make, comments = get_object(values.pop("_target_")), commented(CONF / "dataset" / f"{name}.yaml")
    function = make.__init__ if inspect.isclass(make) else make
    parameters, sentences = inspect.signature(function).parameters, described(function.__doc__)
    del values["occlusion"]
    rows = []
    for key, value in values.items():
        if key == "name":
            continue
        own = sentences.get(key, "")
        sentence = comments.get(key) or ("" if own.startswith(("...", "see ")) else own)
        kind = kind_in_words(parameters[key].annotation)
        rows.append(Setting(f"dataset.{key}", kind, value_in_words(value), "", sentence))
    rows += [row for row in _of_occlusion(name) if row.key.endswith(".kind")]
    return rows


def _of_occlusion(dataset: str) -> list[Setting]:
    values = composed(f"dataset={dataset}")["dataset"]["occlusion"]
    comments = commented(CONF / "occlusion" / "strip.yaml")
    hints, sentences = typing.get_type_hints(OcclusionSettings), described(OcclusionSettings.__doc__)
    return [
        Setting(
            f"dataset.occlusion.{key}",
            kind_in_words(hints[key]),
            value_in_words(value),
            "",
            comments.get(key) or sentences[key],
        )
        for key, value in values.items()
    ]


def _table(rows: Sequence[Setting]) -> list[str]:
    """Returns a table; a setting without a sentence is a mistake in `conf/` or in the docstrings."""
    if bare := [row.key for row in rows if not row.sentence]:
        raise ConfigError(f"settings without a sentence in conf/ or in a docstring: {', '.join(bare)}")
    lines = ["| setting | type | default | allowed | what it is |", "|---|---|---|---|---|"]
    lines += [
        f"| `{row.key}` | {row.kind} | `{row.default}` | {row.allowed} | {row.sentence} |" for row in rows
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
