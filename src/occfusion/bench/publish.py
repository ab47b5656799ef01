"""Tables and the CSV file of a benchmark."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from occfusion.bench.measure import BenchRow
from occfusion.files.table import write_table
from occfusion.report.page import markdown_table

TITLES = {
    "speed": "Speed: forward and backward, contestants in turn",
    "accuracy": "Error against the dense float64 reference",
    "precision": "Work and precision: cut-offs, precision and tiles against blending everything",
    "scaling gaussians": "Scaling with the number of Gaussians",
    "scaling size": "Scaling with the picture",
    "scaling footprint": "Scaling with the Gaussians' sizes",
    "step": "Parts of a training step, forward and backward",
}
_TIMES = ("forward_cpu_ms", "cpu_ms", "cpu_median_ms", "wall_ms", "first_ms", "extra_mb", "speed_up")
_ERRORS = ("error_rgb", "error_alpha", "error_depth", "flips", "error_gradient")
_HEADINGS = {
    "forward_cpu_ms": "forward, CPU ms", "cpu_ms": "both, CPU ms", "cpu_median_ms": "median",
    "wall_ms": "wall ms", "first_ms": "first call, ms", "extra_mb": "extra MB", "speed_up": "x torch",
    "error_rgb": "rgb", "error_alpha": "alpha", "error_depth": "depth, m", "flips": "flipped pixels",
    "error_gradient": "gradients, rel.",
}  # fmt: skip


def write_csv(path: Path, rows: Iterable[BenchRow]) -> None:
    """Writes all rows; an empty field was not measured."""
    write_table(path, [field.name for field in fields(BenchRow)], (asdict(row) for row in rows))


def tables(rows: Sequence[BenchRow], environment: Mapping[str, Any]) -> str:
    """Returns the header and one Markdown table for each part that was measured."""
    sections = ["# Benchmark", _header(environment)]
    for part, title in TITLES.items():
        chosen = [row for row in rows if row.part == part]
        if chosen:
            sections += [f"## {title}", _table(chosen)]
    return "\n\n".join(sections) + "\n"


def _header(environment: Mapping[str, Any]) -> str:
    packages = ", ".join(f"{name} {environment['packages'][name]}" for name in ("torch", "numba", "numpy"))
    changed = " (with changes)" if environment["git_changed"] else ""
    accelerator = "" if environment["accelerator"] is None else f", {environment['accelerator']}"
    return (
        f"{environment['processor']}, {environment['cores']} cores, {environment['threads']} threads used"
        f"{accelerator}; {packages}; revision {environment['git_revision'] or 'unknown'}{changed}; "
        f"{environment['date']}; load {environment['load']}; `{environment['command']}`.\n\n"
        "CPU ms is the least processor time of the process among the rounds, all threads added up. "
        "Settings that a backend refuses are absent."
    )


def _table(rows: Sequence[BenchRow]) -> str:
    columns = [c for c in (*_TIMES, *_ERRORS) if any(getattr(row, c) is not None for row in rows)]
    header = ["case", "contestant", *(_HEADINGS[c] for c in columns)]
    body = [[row.case, row.contestant, *(_cell(c, getattr(row, c)) for c in columns)] for row in rows]
    return markdown_table(header, body)


def _cell(column: str, value: float | None) -> str:
    if value is None:
        return "-"
    if column in _ERRORS:
        return f"{value:.1e}"
    return f"{value:.2f}" if value < 10 else f"{value:.1f}"
