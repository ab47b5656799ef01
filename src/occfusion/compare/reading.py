"""Reads what finished run folders say of themselves; nothing but these folders is opened."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from occfusion.errors import CheckpointError
from occfusion.files.jsonfile import parse_json
from occfusion.files.run_folder import METRICS, STAGES, RunFolder
from occfusion.files.table import read_table

METRIC_KEYS = ("dataset", "scene", "variant", "images", "regions", "perceptual_metric", "train_seconds")


@dataclass(frozen=True)
class CurvePoint:
    """One row of an error curve.

    Attributes:
        seconds: training time since the start of the run, earlier stages included.
        values: `psnr` (dB), `ssim`, `lpips`, `mask_iou`; None where not measured.
    """

    seconds: float
    values: dict[str, float | None]


@dataclass(frozen=True)
class RunRecord:
    """A finished run as its folder describes it.

    Attributes:
        folder: the run folder.
        config: the resolved settings.
        metrics: the content of its `metrics.json`.
        curve: error against training time, in order of time; empty where none was measured.
        decisions: what its plan says of each part: `part`, `used`, `reason`.
    """

    folder: Path
    config: dict[str, Any]
    metrics: dict[str, Any]
    curve: list[CurvePoint]
    decisions: list[dict[str, Any]]

    @property
    def dataset(self) -> str:
        """The data set's name."""
        return str(self.metrics["dataset"])

    @property
    def scene(self) -> str:
        """The scene or subject."""
        return str(self.metrics["scene"])

    @property
    def variant(self) -> str:
        """The row of the paper's Table 2."""
        return str(self.metrics["variant"])

    @property
    def recipe(self) -> str:
        """Which numbers and additions; "ours" for runs that came before there was a choice."""
        return str((self.config.get("recipe") or {}).get("name", "ours"))

    @property
    def seed(self) -> int:
        """The seed."""
        return int(self.config.get("seed", 0))

    @property
    def paper(self) -> dict[str, float]:
        """The paper's own figures for this variant; may be empty."""
        return dict((self.config.get("variant") or {}).get("paper") or {})


@dataclass(frozen=True)
class Fault:
    """A folder or job that gave no result.

    Attributes:
        what: the folder, or the overrides of the job.
        reason: what is wrong and what to do.
    """

    what: str
    reason: str


def find_runs(paths: Iterable[Path]) -> list[Path]:
    """Returns the run folders among `paths` and below those that are none themselves, without repetition.

    Trials of the code (`trainer.fast_dev_run`) are left out unless named. A path without any run folder is returned
    as it is, so that reading it names the fault.
    """
    found: dict[Path, None] = {}
    for path in paths:
        config = RunFolder(path).config
        inside = [] if config.is_file() else sorted(path.glob(f"**/{config.name}"))
        whole = [file.parent for file in inside if not _is_trial(file)]
        for folder in whole or [path]:
            found[folder] = None
    return list(found)


def _is_trial(config: Path) -> bool:
    try:
        return "fast_dev_run: true" in config.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):  # reading the run will say what is wrong
        return False


def read_runs(folders: Iterable[Path]) -> tuple[list[RunRecord], list[Fault]]:
    """Returns the finished runs, and the folders that are unfinished or damaged with the reason."""
    runs: list[RunRecord] = []
    faults: list[Fault] = []
    for folder in folders:
        try:
            runs.append(read_run(folder))
        except CheckpointError as error:
            faults.append(Fault(str(folder), str(error)))
    runs.sort(key=lambda run: (run.dataset, run.scene, variant_rank(run.variant), run.seed, str(run.folder)))
    return runs, faults


def read_run(folder: Path) -> RunRecord:
    """Returns what a finished run's folder holds.

    Raises:
        CheckpointError: no run folder, an unfinished one, or a damaged file; says which.
    """
    own = RunFolder(folder)
    own.check_is_run()
    if not own.metrics.is_file():
        raise CheckpointError(
            f"{folder} is unfinished: {own.metrics.name} is missing; the same training command continues it"
        )
    config = _config(own.config)
    metrics = _mapping(own.metrics, METRIC_KEYS)
    if not isinstance(metrics["regions"], dict) or not isinstance(metrics["train_seconds"], dict):
        raise _damaged(own.metrics, "regions or train_seconds is no table")
    decisions = _mapping(own.plan, ("decisions",))["decisions"]
    try:
        plan = [{key: d[key] for key in ("part", "used", "reason")} for d in decisions]
    except (TypeError, KeyError) as error:
        raise _damaged(own.plan, f"a decision lacks {error}") from error
    if own.curve in own.altered_tables():
        raise _damaged(own.curve, "not as the run left it")
    return RunRecord(folder, config, metrics, _curve(own.curve, metrics["train_seconds"]), plan)


def variant_rank(name: str) -> tuple[int, str]:
    """Returns a key that sorts variants as the paper's Table 2 does: the plain baseline first, then by letter."""
    return (0 if name == "gauhuman" else 1, name)


def _config(path: Path) -> dict[str, Any]:
    try:
        content = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    except (OmegaConfBaseException, OSError, RecursionError, ValueError, YAMLError) as error:
        raise _damaged(path, str(error).splitlines()[0] if str(error) else "") from error
    if not isinstance(content, dict):
        raise _damaged(path, "no settings in it")
    return {str(key): value for key, value in content.items()}


def _mapping(path: Path, keys: Sequence[str]) -> dict[str, Any]:
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise _damaged(path, str(error)) from error
    missing = [key for key in keys if not isinstance(content, dict) or key not in content]
    if missing:
        raise _damaged(path, f"lacks {', '.join(missing)}")
    return dict(content)


def _curve(path: Path, train_seconds: Mapping[str, Any]) -> list[CurvePoint]:
    points = []
    try:
        for row in read_table(path):
            seconds = _before(row["stage"], train_seconds) + float(row["train_seconds"])
            values = {key: float(row[key]) if row[key] else None for key in METRICS}
            if not all(math.isfinite(v) for v in (seconds, *values.values()) if v is not None):
                raise ValueError("a figure is not finite")
            points.append(CurvePoint(seconds, values))
    except (KeyError, TypeError, ValueError, OSError) as error:
        raise _damaged(path, str(error)) from error
    return sorted(points, key=lambda point: point.seconds)


def _before(stage: str, train_seconds: Mapping[str, Any]) -> float:
    """Returns the training seconds of the stages before `stage`."""
    if stage not in STAGES:
        raise ValueError(f"unknown stage {stage!r}")
    return sum(float(train_seconds.get(s) or 0.0) for s in STAGES[: STAGES.index(stage)])


def _damaged(path: Path, why: str) -> CheckpointError:
    return CheckpointError(f"{path} is damaged or missing ({why}); run the same training command again")
