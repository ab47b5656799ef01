"""`python train.py`: composes the configuration, runs it, and turns errors into one plain message."""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

from occfusion.errors import OccfusionError


@dataclass
class _Jobs:
    """What came of the jobs of this call: one, or with `-m` many."""

    results: list[dict[str, Any]] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    exit_code: int = 0


def main(config_dir: Path) -> int:
    """Runs the Hydra application over `config_dir`; returns the process's exit code."""
    jobs = _Jobs()

    # Hydra would print a traceback and exit by itself; a user's mistake deserves one plain line
    @hydra.main(version_base="1.3", config_path=str(config_dir), config_name="config")
    def application(config: DictConfig) -> None:
        _run_job(config, jobs)

    application()
    if len(jobs.results) + len(jobs.failures) > 1:
        _print_table(jobs)
    return jobs.exit_code


def _run_job(config: DictConfig, jobs: _Jobs) -> None:
    from hydra.core.hydra_config import HydraConfig

    # heavy imports only after composing has gone well
    from occfusion import app

    # Lightning's advice on worker counts and missing loggers does not apply to these loaders
    warnings.filterwarnings("ignore", module="lightning.*")
    overrides = HydraConfig.get().overrides.task
    chosen = any(override.lstrip("+").startswith("output_dir=") for override in overrides)
    try:
        jobs.results.append(app.run(config, folder_chosen_by_user=chosen))
    except OccfusionError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        jobs.failures.append(f"{' '.join(overrides)}: {error}")
        jobs.exit_code = getattr(error, "exit_code", 1)


def _print_table(jobs: _Jobs) -> None:
    from occfusion.tables import print_comparison

    print_comparison(jobs.results)
    for failure in jobs.failures:
        print(f"failed: {failure}")
