"""What a job returns to Hydra: the figure of `metrics.json` that a sweeper makes as large or small as it can."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from occfusion.cli.multirun import JobRecord
from occfusion.errors import ConfigError
from occfusion.fields import check_choice
from occfusion.files.run_folder import FIGURES, REGIONS, STAGES, RunFolder

KNOWN = (
    *(f"regions.{region}.{figure}" for region in REGIONS for figure in FIGURES),
    *(f"train_seconds.{stage}" for stage in (*STAGES, "total")),
    "gaussians",
    "peak_memory_mb",
)
"""The figures of `metrics.json`, by their dotted names."""
PLAIN_SWEEPER = "BasicSweeper"
"""Hydra's own, which asks for nothing."""


def check_optimized_metric(name: str) -> None:
    """Refuses what `metrics.json` never has.

    Raises:
        ConfigError: with what there is.
    """
    check_choice("optimized_metric", name, KNOWN)


def read_metric(folder: Path, name: str) -> float | None:
    """Returns a figure of a run's `metrics.json`; None where it could not be computed."""
    value: Any = RunFolder(folder).read_metrics()
    for key in name.split("."):
        value = value.get(key)
        if value is None:
            return None
    return float(value)


def answer(job: JobRecord, name: str, *, is_asked: bool) -> float | None:
    """Returns what a job gives to the sweeper; None where it has no such figure and nobody asks for it.

    Args:
        job: that has ended.
        name: of the figure, checked by `check_optimized_metric`.
        is_asked: whether the sweeper goes by the answer.

    Raises:
        ConfigError: the sweeper asks, and there is none.
    """
    value = None if job.folder is None else read_metric(Path(job.folder), name)
    if value is not None or not is_asked:
        return value
    why = "this job measures nothing"
    if job.folder is not None:
        why = f"{RunFolder(Path(job.folder)).metrics} has null there"
    raise ConfigError(f"{job.overrides}: no {name} for the sweeper: {job.error or why}; see optimized_metric")


def is_asked(sweeper: Mapping[str, Any]) -> bool:
    """Returns whether a sweeper goes by what jobs return."""
    return not str(sweeper.get("_target_", PLAIN_SWEEPER)).endswith(PLAIN_SWEEPER)
