"""Tables, the CSV file and the pictures of a benchmark."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from occfusion.bench.measure import BenchRow
from occfusion.bench.plan import KNOBS, TILE_KNOB
from occfusion.files.atomic import write_bytes
from occfusion.files.table import write_table
from occfusion.report.drawing import new_figure, png
from occfusion.report.page import markdown_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
AXES = ("gaussians", "size", "footprint")
_TIME_LABEL = "forward + backward, CPU ms"
_DEFAULT_CASES = ("alpha floor 1/255", "transmittance stop 0.0001")


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


def draw_scaling(path: Path, rows: Sequence[BenchRow]) -> None:
    """Draws processor time and memory against each axis, one line a contestant."""
    measured = [axis for axis in AXES if any(row.part == f"scaling {axis}" for row in rows)]
    drawing = new_figure(4 * max(len(measured), 1), 6)
    for column, axis in enumerate(measured, 1):
        chosen = [row for row in rows if row.part == f"scaling {axis}"]
        for below, (field, label) in enumerate((("cpu_ms", _TIME_LABEL), ("extra_mb", "extra MB"))):
            axes = drawing.add_subplot(2, len(measured), column + below * len(measured))
            for contestant in dict.fromkeys(row.contestant for row in chosen):
                line = [row for row in chosen if row.contestant == contestant]
                _plot(axes, line, axis, field, "o-", contestant)
            _finish(axes, axis, label)
    _save(drawing, path)


def draw_precision(path: Path, rows: Sequence[BenchRow]) -> None:
    """Draws time against error: one line for each knob and contestant, the defaults marked."""
    chosen = [row for row in rows if row.part == "precision"]
    drawing = new_figure(11, 5)
    panels = (("error_rgb", "largest colour error"), ("error_gradient", "gradients, relative error"))
    for number, (field, label) in enumerate(panels, 1):
        axes = drawing.add_subplot(1, 2, number)
        for contestant in dict.fromkeys(row.contestant for row in chosen):
            for knob in (*KNOBS, TILE_KNOB):
                line = [row for row in chosen if row.contestant == contestant and row.case.startswith(knob)]
                _plot(axes, line, field, "cpu_ms", "o-", f"{contestant}, {knob}")
        _plot(axes, [row for row in chosen if row.case in _DEFAULT_CASES], field, "cpu_ms", "k*", "defaults")
        _finish(axes, label, _TIME_LABEL)
    _save(drawing, path)


def _plot(axes: Axes, rows: Sequence[BenchRow], x: str, y: str, style: str, label: str) -> None:
    # a value of 0, or one that was not measured, has no place on a logarithmic axis
    pairs = [(getattr(row, x), getattr(row, y)) for row in rows if getattr(row, x) and getattr(row, y)]
    if pairs:
        axes.plot([pair[0] for pair in pairs], [pair[1] for pair in pairs], style, label=label)


def _finish(axes: Axes, x_label: str, y_label: str) -> None:
    from matplotlib.ticker import NullFormatter

    axes.set(xscale="log", yscale="log", xlabel=x_label, ylabel=y_label)
    # within one decade the labels between powers of ten run into each other
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3, which="both")


def _save(drawing: Figure, path: Path) -> None:
    if drawing.axes:
        drawing.axes[0].legend(fontsize=7)
    write_bytes(path, png(drawing))
