"""The pictures of a benchmark."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from occfusion.bench.measure import BenchRow
from occfusion.bench.plan import KNOBS, TILE_KNOB
from occfusion.files.atomic import write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AXES = ("gaussians", "size", "footprint")
_TIME_LABEL = "forward + backward, CPU ms"
_DEFAULT_CASES = ("alpha floor 1/255", "transmittance stop 0.0001")


def draw_scaling(path: Path, rows: Sequence[BenchRow]) -> None:
    """Draws processor time and memory against each axis, one line a contestant."""
    measured = [axis for axis in AXES if any(row.part == f"scaling {axis}" for row in rows)]
    drawing = _new_figure(4 * max(len(measured), 1), 6)
    for column, axis in enumerate(measured, 1):
        chosen = [row for row in rows if row.part == f"scaling {axis}"]
        for line, (field, label) in enumerate((("cpu_ms", _TIME_LABEL), ("extra_mb", "extra MB"))):
            axes = drawing.add_subplot(2, len(measured), column + line * len(measured))
            for contestant in dict.fromkeys(row.contestant for row in chosen):
                _plot(
                    axes,
                    [row for row in chosen if row.contestant == contestant],
                    axis,
                    field,
                    "o-",
                    contestant,
                )
            _finish(axes, axis, label)
    _save(drawing, path)


def draw_precision(path: Path, rows: Sequence[BenchRow]) -> None:
    """Draws time against error: one line for each knob and contestant, the defaults marked."""
    chosen = [row for row in rows if row.part == "precision"]
    drawing = _new_figure(11, 5)
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


def _new_figure(width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(drawing)
    return drawing


def _save(drawing: Figure, path: Path) -> None:
    if drawing.axes:
        drawing.axes[0].legend(fontsize=7)
    buffer = io.BytesIO()
    drawing.savefig(buffer, format="png", dpi=110)
    write_bytes(path, buffer.getvalue())
