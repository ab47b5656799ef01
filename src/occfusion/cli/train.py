"""`python train.py`, `occfusion train`: composes the configuration, runs it, turns errors into one plain message."""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from occfusion.cli.guarded import check_arguments, guarded_hydra, mode_by_flags
from occfusion.cli.interrupts import is_interrupted, keep_interrupts
from occfusion.cli.launchers import is_parallel, missing_launcher
from occfusion.cli.multirun import OUTCOME, JobRecord, end_of_broken_multirun, record_job, record_start
from occfusion.cli.optimized import answer, check_optimized_metric, is_asked
from occfusion.cpu.loading import loading
from occfusion.cpu.processes import is_helper
from occfusion.errors import ConfigError, OccfusionError
from occfusion.settings.names import refuse_old_names

NOT_IN_A_MULTIRUN = (
    "trainer.devices > 1 starts more processes with the same command line, which a multirun is not for; run the "
    "scenes one by one, or with one device each"
)
STOPPED = "stopped by SIGINT: the same command continues"


@dataclass
class _State:
    """What came of the jobs of this process.

    Attributes:
        exit_code: of the last job.
        stopped: why no further job is to be started.
    """

    exit_code: int = 0
    stopped: str | None = None


def find_config_dir() -> Path:
    """Returns the folder of the configuration: within an installed package, in the repository beside `src/`.

    Raises:
        ConfigError: it is in neither place.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "conf", package.parents[1] / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise ConfigError(
        f"{package / 'conf'}: config.yaml is missing, the package is not installed whole; install it anew, from a "
        "wheel or with `pip install -e .` in the repository"
    )


def main(config_dir: Path, arguments: Sequence[str] | None = None) -> int:
    """Runs the Hydra application; returns the process's exit code.

    Args:
        config_dir: folder of the configuration.
        arguments: what Hydra is to read; None: the whole command line.
    """
    keep_interrupts()
    whole = sys.argv
    given = whole[1:] if arguments is None else list(arguments)
    state = _State()
    OUTCOME.exit_code = 0
    if is_helper():  # one process tells the user enough; errors are another matter
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    elif not any(word.startswith("-") and word not in ("-m", "--multirun") for word in given):
        print("occfusion: the settings are read", file=sys.stderr, flush=True)  # heavy imports are silent
    if (problem := missing_launcher(given) or _refused(given)) is not None:
        print(f"ConfigError: {problem}", file=sys.stderr)
        return 1

    # Hydra would print a traceback and exit by itself; a user's mistake deserves one plain line
    @hydra.main(version_base="1.3", config_path=str(config_dir), config_name="config")
    def application(config: DictConfig) -> float | None:
        if is_interrupted():
            raise KeyboardInterrupt
        sys.argv = whole  # runs keep it, and helpers of this process are started with it
        settings = HydraConfig.get()
        overrides = [
            str(word) for word in OmegaConf.to_container(settings.overrides.task, resolve=False) or ()
        ]
        if settings.mode == RunMode.MULTIRUN:
            sweep, number = Path(settings.sweep.dir), settings.job.num
            record_start(sweep, number, " ".join(overrides))
            if is_parallel(settings.launcher):
                config.trainer.enable_progress_bar = (
                    False  # lines of several processes would run into each other
                )
            try:
                job = _job_of_many(config, overrides, number, state)
            except KeyboardInterrupt:  # where nothing else answers the signal
                record_job(sweep, JobRecord(number, " ".join(overrides), error=STOPPED, exit_code=130))
                raise
            record_job(sweep, job)
            return answer(job, config.optimized_metric, is_asked=is_asked(settings.sweeper))
        job = _job(config, overrides, 0)
        state.exit_code = job.exit_code
        return answer(job, config.optimized_metric, is_asked=False)

    sys.argv = [whole[0], *given]  # Hydra reads nothing else
    try:
        with guarded_hydra(), contextlib.nullcontext() if _may_name_mode(given) else mode_by_flags():
            application()
    except (SystemExit, KeyboardInterrupt) as end:
        if isinstance(end, SystemExit) and not is_interrupted():  # Hydra has said why
            if OUTCOME.sweep is None:
                _hint(given)
                raise
            end_of_broken_multirun(1)
            return OUTCOME.exit_code or state.exit_code
        print(STOPPED, file=sys.stderr)
        state.exit_code = 130
        end_of_broken_multirun(130)
    finally:
        sys.argv = whole
    return OUTCOME.exit_code or state.exit_code


def _may_name_mode(arguments: Sequence[str]) -> bool:
    """Returns whether a configuration may say that there are many jobs: one of the user's, or an override for Hydra."""
    return any("hydra" in word or word.startswith(("-cd", "--c")) for word in arguments)


def _refused(arguments: Sequence[str]) -> str | None:
    """Returns what is wrong with the first argument that has another name now or executes a file; None for nothing."""
    try:
        check_arguments(arguments)
        refuse_old_names(_keys(arguments))
    except ConfigError as error:
        return str(error)
    return None


def _hint(arguments: Sequence[str]) -> None:
    """Says which setting may be meant by one that there is not, after Hydra has refused it."""
    from occfusion.fields import nearest
    from occfusion.settings.schema import known_settings

    known = known_settings()
    for key in _keys(arguments):
        if "." in key and key not in known and not key.startswith("hydra."):
            print(f"ConfigError: setting {key}: unknown; {nearest(key, known, few=True)}", file=sys.stderr)


def _keys(arguments: Sequence[str]) -> list[str]:
    return [argument.partition("=")[0].lstrip("+~") for argument in arguments if "=" in argument]


def _job_of_many(config: DictConfig, overrides: list[str], number: int, state: _State) -> JobRecord:
    """Runs a job of a multirun; whatever happens to it, the others are not lost."""
    called = " ".join(overrides)
    if config.trainer.devices != 1:
        return JobRecord(number, called, error=NOT_IN_A_MULTIRUN, exit_code=1)
    if state.stopped is not None:
        return JobRecord(number, called, error=f"not started: {state.stopped}", exit_code=1)
    try:
        job = _job(config, overrides, number)
    except Exception as error:  # a fault of the program in one job: shown in full, the others go on
        traceback.print_exc()
        return JobRecord(number, called, error=f"{type(error).__name__}: {error}", exit_code=1)
    if job.exit_code > 128:  # a signal meant for the whole command
        state.stopped = "the jobs were stopped by a signal; the same command continues"
    return job


def _job(config: DictConfig, overrides: list[str], number: int) -> JobRecord:
    chosen = any(override.lstrip("+").startswith("output_dir=") for override in overrides)
    called = " ".join(overrides)
    try:
        check_optimized_metric(config.optimized_metric)
        folder = _finished_before(config, chosen) or _run(config, chosen, overrides)
    except OccfusionError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return JobRecord(number, called, error=str(error), exit_code=_exit_code(error))
    return JobRecord(number, called, folder=None if folder is None else str(folder))


def _exit_code(error: OccfusionError) -> int:
    code: int = getattr(error, "exit_code", 1)
    # a helper that was stopped has done its duty; Lightning would kill all others over any other code
    return 0 if is_helper() and code > 128 else code


def _finished_before(config: DictConfig, chosen: bool) -> Path | None:
    """Returns the folder of the same run where it is finished; prints its figures."""
    from occfusion.report.tables import print_summary
    from occfusion.run.folder import find_finished
    from occfusion.settings.schema import load_settings

    finished = find_finished(load_settings(config), chosen_by_user=chosen)
    if finished is None:
        return None
    folder, figures = finished
    print(f"finished before, taken from {folder}")
    print_summary(folder, figures)
    return folder


def _run(config: DictConfig, chosen: bool, overrides: list[str]) -> Path | None:
    # heavy imports only after composing has gone well and where there is something to do; what earlier jobs of this
    # process have left is to be searched for garbage
    with contextlib.nullcontext() if "occfusion.run.app" in sys.modules else loading():
        from occfusion.run import app

    folder, metrics = app.run_in_folder(config, folder_chosen_by_user=chosen, given=overrides)
    return folder if "regions" in metrics else None
