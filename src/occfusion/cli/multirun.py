"""The end of `python train.py -m`: one table over all jobs, in files and on the terminal.

Jobs may run in processes of their own (Hydra's launchers), so each leaves a small record in the sweep's folder:
one when it begins, and another in its place when it ends.
"""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from occfusion.files.atomic import write_bytes, write_json
from occfusion.files.jsonfile import parse_json

JOBS = "jobs"
NO_LAST_WORD = "its process ended without a word (killed, or out of memory); the same command continues it"


@dataclass(frozen=True)
class JobRecord:
    """What came of one job.

    Attributes:
        number: of the job in the sweep.
        overrides: what the job was asked for.
        folder: its run folder; None when it failed or measures nothing.
        error: why it failed; None when it did not.
        exit_code: what a process of this job alone would return.
    """

    number: int
    overrides: str
    folder: str | None = None
    error: str | None = None
    exit_code: int = 0


@dataclass
class Outcome:
    """What the multirun of this process has come to.

    Attributes:
        exit_code: of the command, as far as the jobs decide it.
        sweep: folder of a multirun that has begun and not ended.
    """

    exit_code: int = 0
    sweep: Path | None = None


OUTCOME = Outcome()


def record_job(sweep: Path, job: JobRecord) -> None:
    """Leaves a job's record in the sweep's folder."""
    write_json(sweep / JOBS / f"{job.number}.json", asdict(job))


def record_start(sweep: Path, number: int, overrides: str) -> None:
    """Leaves the record of a job that has begun: what stands there if its process is killed."""
    record_job(sweep, JobRecord(number, overrides, error=NO_LAST_WORD, exit_code=1))


class EndTable(Callback):
    """Hydra's callback that writes the table when all jobs have ended."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Removes the records of an earlier sweep."""
        OUTCOME.sweep = Path(config.hydra.sweep.dir)
        shutil.rmtree(OUTCOME.sweep / JOBS, ignore_errors=True)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Writes `table.md`, `table.csv` and `table.tex`, prints the figures and what failed."""
        OUTCOME.exit_code = write_end_table(Path(config.hydra.sweep.dir))
        OUTCOME.sweep = None


def end_of_broken_multirun(exit_code: int) -> None:
    """Writes the table of a multirun whose launcher gave up, from the jobs that left a record.

    Args:
        exit_code: of the command; one of a signal (above 128) stands whatever became of the jobs.
    """
    if OUTCOME.sweep is None:
        return
    print("the launcher ended before all jobs had; those that had begun:")
    of_jobs = write_end_table(OUTCOME.sweep)
    OUTCOME.exit_code = exit_code if exit_code > 128 else of_jobs or exit_code
    OUTCOME.sweep = None


def write_end_table(sweep: Path) -> int:
    """Writes and prints the table of a sweep's jobs; returns the exit code, that of the first failed job.

    Args:
        sweep: the sweep's folder, with a record for each job in `jobs/`.
    """
    from occfusion.compare.page import faults_markdown, tables_markdown
    from occfusion.compare.reading import Fault, read_runs
    from occfusion.compare.tables import write_latex, write_summary_csv
    from occfusion.report.tables import print_comparison

    files = sorted((sweep / JOBS).glob("*.json"), key=lambda file: int(file.stem))
    jobs = [JobRecord(**parse_json(file.read_text(encoding="utf-8"))) for file in files]
    failed = [Fault(job.overrides, job.error) for job in jobs if job.error is not None]
    runs, unreadable = read_runs(dict.fromkeys(Path(job.folder) for job in jobs if job.folder is not None))
    faults = [*failed, *unreadable]
    title = f"# {len(jobs)} jobs, {len(runs)} finished runs, {len(faults)} without a result"
    text = "\n\n".join(part for part in (title, faults_markdown(faults), tables_markdown(runs)) if part)
    write_bytes(sweep / "table.md", (text + "\n").encode())
    write_summary_csv(sweep / "table.csv", runs)
    write_latex(sweep / "table.tex", runs, faults)
    if runs:
        print_comparison([run.metrics for run in runs])
    for fault in faults:
        print(f"failed: {fault.what}: {fault.reason}")
    print(f"tables: {sweep / 'table.md'}, table.csv, table.tex")
    codes = [job.exit_code for job in jobs if job.exit_code]
    return codes[0] if codes else int(bool(faults))
