"""The table, the curves and the page of a sweep."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, fields
from html import escape
from pathlib import Path
from typing import Any

from occfusion.files.atomic import write_bytes
from occfusion.files.table import write_table
from occfusion.report.drawing import BELOW, PANEL_HEIGHT, make_logarithmic, panels, png
from occfusion.report.page import markdown_table
from occfusion.stability.axes import Row

PANEL, MARGIN, COLUMNS = (330, 210), (46, 26), 3
FLOOR, CEILING = -17, 1
"""Powers of ten that curves are drawn between; an error of 0 lies on the lower edge."""
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1100px; padding: 0 1em; color: #222 }
table { border-collapse: collapse } th, td { padding: .2em .7em; border-bottom: 1px solid #ddd; text-align: right }
th:first-child, td:first-child, td:nth-child(3) { text-align: left } .exceeds { background: #fdecea }
svg { max-width: 100%; height: auto }
"""
HEADINGS = ("axis", "at", "method", "error", "bound", "error of gradient", "bound", "ms", "verdict")
NOTE = (
    "Errors are relative, in the 2-norm, against float64 code that shares nothing with what is measured; of gradients "
    "the worst input's. Solid curves: the value; dashed: its gradients. Synthetic scenes, made from a fixed seed."
)


def write_sweep(output: Path, rows: Sequence[Row], environment: dict[str, Any]) -> None:
    """Writes `stability.csv`, `.md`, `.svg` and `.html`, which shows all of it in one file.

    Args:
        output: the folder, made when missing.
        rows: of all axes.
        environment: of this process.
    """
    write_table(
        output / "stability.csv", [field.name for field in fields(Row)], (asdict(row) for row in rows)
    )
    head = (
        f"{summary(rows)}. {environment['processor']}, {environment['threads']} threads, torch "
        f"{environment['packages']['torch']}, {environment['date']}, `{environment['command']}`."
    )
    drawing = curves(rows)
    cells = [_cells(row) for row in rows]
    picture = "![errors along each axis](stability.svg)"
    text = ["# Stability", head, NOTE, picture, markdown_table(HEADINGS, cells)]
    write_bytes(output / "stability.md", ("\n\n".join(text) + "\n").encode())
    write_bytes(output / "stability.svg", drawing.encode())
    write_bytes(output / "stability_time.png", draw_error_vs_time(rows))
    lines = "".join(
        f'<tr class="{"" if row.verdict == "holds" else "exceeds"}">'
        + "".join(f"<td>{escape(cell)}</td>" for cell in shown)
        + "</tr>"
        for row, shown in zip(rows, cells, strict=True)
    )
    titles = "".join(f"<th>{title}</th>" for title in HEADINGS)
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Stability</title><style>{STYLE}</style>'
        f"<h1>Stability</h1><p>{escape(head)}</p><p>{escape(NOTE)}</p>{drawing}<table><tr>{titles}</tr>{lines}</table></html>"
    )
    write_bytes(output / "stability.html", page.encode())


def summary(rows: Sequence[Row]) -> str:
    """Returns how many cases hold, in words."""
    axes = len({row.axis for row in rows})
    return f"{sum(row.verdict == 'holds' for row in rows)} of {len(rows)} cases on {axes} axes hold"


def _cells(row: Row) -> list[str]:
    def short(value: float | None) -> str:
        return "-" if value is None else f"{value:.1e}"

    return [
        row.axis, f"{row.place:.10g}", row.method, short(row.error), f"{row.bound:.0e}", short(row.gradient_error),
        f"{row.gradient_bound:.0e}", "-" if row.milliseconds is None else f"{row.milliseconds:.2f}", row.verdict,
    ]  # fmt: skip


def curves(rows: Sequence[Row]) -> str:
    """Returns a drawing with a panel for each axis: errors of each method from place to place."""
    axes = list(dict.fromkeys(row.axis for row in rows))
    width, height = COLUMNS * PANEL[0], math.ceil(len(axes) / COLUMNS) * PANEL[1]
    drawn = "".join(
        f'<g transform="translate({k % COLUMNS * PANEL[0]} {k // COLUMNS * PANEL[1]})">'
        f"{_panel(axis, [row for row in rows if row.axis == axis])}</g>"
        for k, axis in enumerate(axes)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        f'font-family="sans-serif" font-size="10"><rect width="100%" height="100%" fill="white"/>{drawn}</svg>'
    )


def _panel(axis: str, rows: Sequence[Row]) -> str:
    places = list(dict.fromkeys(row.place for row in rows))
    methods = list(dict.fromkeys(row.method for row in rows))
    left, top = MARGIN
    wide, high = PANEL[0] - left - 12, PANEL[1] - top - 34

    def x(place: float) -> float:
        return left + wide * (places.index(place) + 0.5) / len(places)

    def y(error: float) -> float:
        power = FLOOR if error == 0 else min(max(math.log10(error), FLOOR), CEILING)
        return top + high * (CEILING - power) / (CEILING - FLOOR)

    parts = [f'<text x="{left}" y="14" font-weight="bold">{escape(axis)}</text>']
    for power in range(CEILING - 1, FLOOR, -4):
        parts.append(
            f'<path d="M{left} {y(10.0**power):.1f}h{wide}" stroke="#ddd"/>'
            f'<text x="{left - 4}" y="{y(10.0**power) + 3:.1f}" text-anchor="end">1e{power}</text>'
        )
    parts += [
        f'<text x="{x(place):.1f}" y="{top + high + 11}" text-anchor="middle" font-size="8">{place:.3g}</text>'
        for place in places
    ]
    for number, method in enumerate(methods):
        color, own = COLORS[number % len(COLORS)], [row for row in rows if row.method == method]
        for name, dash in (("error", ""), ("gradient_error", ' stroke-dasharray="3 3"')):
            known = [(row.place, getattr(row, name)) for row in own]
            points = " ".join(
                f"{x(p):.1f},{y(e):.1f}" for p, e in known if e is not None and math.isfinite(e)
            )
            parts.append(f'<polyline points="{points}" fill="none" stroke="{color}"{dash}/>')
        at = left + number * wide / len(methods)
        parts.append(
            f'<text x="{at:.0f}" y="{top + high + 26}" fill="{color}" font-size="9">{escape(method)}</text>'
        )
    return "".join(parts)


def draw_error_vs_time(rows: Sequence[Row]) -> bytes:
    """Returns a PNG with a panel an axis: the error of gradients against the time of a call, from place to place.

    A dot is a place; the larger, the further along the axis. Errors of nothing are drawn at 1e-17.
    """
    names = list(dict.fromkeys(row.axis for row in rows))
    figure, axes = panels(len(names), 4, PANEL_HEIGHT, BELOW)
    for name, panel in zip(names, axes, strict=True):
        own = [row for row in rows if row.axis == name]
        for number, method in enumerate(dict.fromkeys(row.method for row in own)):
            line = [
                (row.milliseconds, max(row.gradient_error or 0.0, row.error or 0.0, 1e-17))
                for row in own
                if row.method == method and row.milliseconds is not None
            ]
            if not line:
                continue
            times, errors = zip(*line, strict=True)
            panel.plot(times, errors, "-", color=f"C{number}", lw=0.7, label=method)
            panel.scatter(times, errors, s=[6 + 4 * k for k in range(len(line))], color=f"C{number}")
        make_logarithmic(panel)
        panel.set_title(name, fontsize=8)
        panel.set_xlabel("ms", fontsize=8)
        panel.legend(fontsize=6)
    return png(figure)
