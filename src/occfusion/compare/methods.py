"""Names for the methods that runs stand for: the variant, and the settings in which runs of a variant differ."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from occfusion.compare.reading import RunRecord

NOT_A_DIFFERENCE = (
    "seed", "output_dir", "shared_dir", "dataset.scene", "dataset.root", "body.path", "stage.", "variant.",
    "evaluation.", "trainer.enable_progress_bar", "trainer.checkpoint_every",
)  # fmt: skip
"""Settings (or, with a dot at the end, groups) that do not make two runs of a variant different methods."""
PRESETS = ("recipe.name", "speed.name")
"""Choices that stand for all that they set."""
SPELT_OUT = 2
"""Up to so many differing settings stand in a method's name; with more, methods of a variant are numbered."""


def methods(runs: Sequence[RunRecord]) -> list[str]:
    """Returns a name for each run's method, the same for runs that differ in seed or scene alone."""
    return [name for name, _ in _named(runs)]


def method_settings(runs: Sequence[RunRecord]) -> dict[str, str]:
    """Returns the settings that numbered methods stand for, by name; empty when no method is numbered."""
    return {name: settings for name, settings in _named(runs) if "#" in name}


def _named(runs: Sequence[RunRecord]) -> list[tuple[str, str]]:
    flat = [dict(_flat(run.config)) for run in runs]
    groups: dict[tuple[str, str], list[int]] = {}
    for k, run in enumerate(runs):
        groups.setdefault((run.dataset, run.variant), []).append(k)
    result = [(run.variant, "") for run in runs]
    for (_, variant), members in groups.items():
        differing = _differing([flat[k] for k in members])
        texts = {
            k: " ".join(f"{key.removesuffix('.name')}={flat[k].get(key)}" for key in differing)
            for k in members
        }
        numbers = {text: n for n, text in enumerate(dict.fromkeys(texts.values()), 1)}
        for k, text in texts.items():
            numbered = f"{variant} #{numbers[text]}"
            result[k] = (numbered if len(differing) > SPELT_OUT else f"{variant} {text}".strip(), text)
    return result


def _differing(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns the settings in which runs differ; the name of a preset stands for all that it sets."""
    by_preset: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for config in configs:
        by_preset.setdefault(tuple(config.get(preset) for preset in PRESETS), []).append(config)
    found = {
        key
        for alike in by_preset.values()
        for key in {key for config in alike for key in config}
        if len({str(config.get(key)) for config in alike}) > 1
    }
    chosen = {preset for preset in PRESETS if len({config.get(preset) for config in configs}) > 1}
    return sorted(found | chosen)


def _flat(config: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in config.items():
        name = f"{prefix}{key}"
        if any(name == part or (part.endswith(".") and name.startswith(part)) for part in NOT_A_DIFFERENCE):
            continue
        if isinstance(value, Mapping):
            yield from _flat(value, f"{name}.")
        else:
            yield name, value
