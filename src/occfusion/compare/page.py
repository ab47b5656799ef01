"""The comparison of runs as a self-contained HTML page and as Markdown."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import cv2

from occfusion.compare.curves import curves_svg
from occfusion.compare.grid import GridRow, joined, picture_grid
from occfusion.compare.methods import method_settings, methods
from occfusion.compare.reading import Fault, RunRecord
from occfusion.compare.tables import NOTES, Grid, all_grids, run_grid, write_latex, write_summary_csv
from occfusion.evaluation.pictures import ERROR_GAIN, Image
from occfusion.files.atomic import write_bytes, write_png
from occfusion.report.page import markdown_table

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1500px; padding: 0 1em; color: #222 }
.wide { overflow-x: auto } table { border-collapse: collapse; margin: .6em 0 1.4em }
th, td { padding: .25em .7em; border-bottom: 1px solid #ddd; text-align: right;
  vertical-align: top; white-space: nowrap }
th:first-child, td:first-child, th:nth-child(2), td:nth-child(2), .text td { text-align: left }
.text td { white-space: normal }
th { background: #f3f3f3 } .paper { background: #fdf3dc; border-left: 1px solid #e5cf95 }
.fault { background: #fdecea; padding: .4em 1em } svg { max-width: 100%; height: auto }
.grid td { padding: 1px; text-align: center; font-size: 12px } .grid img { display: block; margin: auto; height: 280px }
"""
CURVE_NOTE = (
    "On a fixed handful of held-out images; seconds of training since the start of the run, all stages; the clock "
    "stands still while errors are measured."
)
GRID_NOTE = f"Held-out views; errors are the mean absolute difference, {ERROR_GAIN:g} times amplified."


@dataclass(frozen=True)
class _Scene:
    title: str
    curves: str
    rows: list[GridRow]
    remarks: list[str]


def write_pages(output: Path, runs: Sequence[RunRecord], faults: Sequence[Fault]) -> tuple[Path, Path]:
    """Writes `report.html`, `report.md` with its pictures, `summary.csv` and `summary.tex`; returns the first two.

    The page holds all it shows; the Markdown file links to files beside it.

    Args:
        output: the folder, made when missing.
        runs: finished runs.
        faults: folders that are unfinished or damaged.
    """
    scenes = _scenes(runs)
    write_bytes(output / "report.html", _html(runs, faults, scenes).encode())
    write_bytes(output / "report.md", _markdown(output, runs, faults, scenes).encode())
    write_summary_csv(output / "summary.csv", runs)
    write_latex(output / "summary.tex", runs, faults)
    return output / "report.html", output / "report.md"


def left_out(runs: Sequence[RunRecord]) -> list[list[str]]:
    """Returns one row for each part that a run left out: the runs that did, the part, the reason."""
    names = methods(runs)
    who: dict[tuple[str, str], dict[str, None]] = {}
    for run, name in zip(runs, names, strict=True):
        for decision in run.decisions:
            if not decision["used"]:
                told = (str(decision["part"]), str(decision["reason"]))
                who.setdefault(told, {})[f"{run.scene} {name}"] = None
    return [[part, reason, ", ".join(members)] for (part, reason), members in who.items()]


def _scenes(runs: Sequence[RunRecord]) -> list[_Scene]:
    names = methods(runs)
    scenes = []
    for key in dict.fromkeys((run.dataset, run.scene) for run in runs):
        members = [k for k, run in enumerate(runs) if (run.dataset, run.scene) == key]
        of_scene, called = [runs[k] for k in members], [names[k] for k in members]
        scenes.append(_Scene(" ".join(key), curves_svg(of_scene, called), *picture_grid(of_scene, called)))
    return scenes


def _html(runs: Sequence[RunRecord], faults: Sequence[Fault], scenes: Sequence[_Scene]) -> str:
    parts = [f"<h1>Comparison of {len(runs)} runs</h1>"]
    if faults:
        items = "".join(f"<li><b>{escape(f.what)}</b>: {escape(f.reason)}</li>" for f in faults)
        parts.append(f'<div class="fault"><h2>Without a result</h2><ul>{items}</ul></div>')
    parts.append("<h2>Error against training time</h2><p>" + CURVE_NOTE + "</p>")
    parts += [f"<h3>{escape(s.title)}</h3>{s.curves or '<p>no run has a curve</p>'}" for s in scenes]
    parts.append(f"<h2>Figures</h2><p>{escape(NOTES.replace('`', ''))}</p>")
    for title, grid in [*all_grids(runs), ("Run by run", run_grid(runs))]:
        parts.append(f"<h3>{escape(title)}</h3>{_html_table(grid)}")
    if settings := method_settings(runs):
        parts.append(
            _html_table((["variant", "settings"], [list(item) for item in settings.items()]), "text")
        )
    parts.append(f"<h2>Pictures</h2><p>{GRID_NOTE}</p>")
    parts += [f"<h3>{escape(s.title)}</h3>{_html_grid(s)}" for s in scenes]
    parts.append("<h2>What was left out, and why</h2>")
    parts.append(_html_table((["part", "why", "runs"], left_out(runs)), "text"))
    body = "\n".join(parts)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>Comparison of runs</title>'
        f"<style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def _html_table(grid: Grid, style: str = "") -> str:
    header, rows = grid
    marks = [' class="paper"' if title.startswith("paper ") else "" for title in header]

    def line(cells: Sequence[str], tag: str) -> str:
        filled = (f"<{tag}{m}>{escape(c)}</{tag}>" for m, c in zip(marks, cells, strict=True))
        return f"<tr>{''.join(filled)}</tr>"

    content = "\n".join([line(header, "th"), *(line(row, "td") for row in rows)])
    return f'<div class="wide"><table class="{style}">{content}</table></div>'


def _html_grid(scene: _Scene) -> str:
    lines = []
    for row in scene.rows:
        cells = [
            f"<td>{escape(title)}{_img(f'{row.view}: {title}', image)}</td>" for title, image in row.cells
        ]
        lines.append(f'<tr><td colspan="{len(cells)}">{escape(row.view)}</td></tr><tr>{"".join(cells)}</tr>')
    table = f'<div class="wide"><table class="grid">{"".join(lines)}</table></div>' if lines else ""
    return table + "".join(f"<p>{escape(remark)}</p>" for remark in scene.remarks)


def _img(text: str, image: Image) -> str:
    content = base64.b64encode(cv2.imencode(".png", image[..., ::-1])[1].tobytes()).decode()
    return f'<img alt="{escape(text)}" src="data:image/png;base64,{content}">'


def _markdown(
    output: Path, runs: Sequence[RunRecord], faults: Sequence[Fault], scenes: Sequence[_Scene]
) -> str:
    parts = [f"# Comparison of {len(runs)} runs", faults_markdown(faults)]
    parts.append(f"## Error against training time\n\n{CURVE_NOTE}")
    for number, scene in enumerate(scenes, 1):
        if scene.curves:
            write_bytes(output / f"curves-{number}.svg", scene.curves.encode())
        link = f"![error against time](curves-{number}.svg)" if scene.curves else "no run has a curve"
        parts.append(f"### {scene.title}\n\n{link}")
    parts.append(tables_markdown(runs))
    parts.append(f"## Pictures\n\n{GRID_NOTE}")
    for number, scene in enumerate(scenes, 1):
        parts.append(f"### {scene.title}")
        if scene.rows:
            write_png(output / f"pictures-{number}.png", joined(scene.rows))
            columns = ", ".join(title for title, _ in scene.rows[0].cells)
            views = ", ".join(row.view for row in scene.rows)
            parts.append(f"From left to right: {columns}. From top to bottom: {views}.")
            parts.append(f"![{scene.title}](pictures-{number}.png)")
        parts += scene.remarks
    parts.append("## What was left out, and why")
    parts.append(markdown_table(["part", "why", "runs"], left_out(runs)))
    return "\n\n".join(part for part in parts if part) + "\n"


def tables_markdown(runs: Sequence[RunRecord]) -> str:
    """Returns the summary tables and the table of runs."""
    tables = [f"### {title}\n\n{markdown_table(*grid)}" for title, grid in all_grids(runs)]
    settings = [[name, text] for name, text in method_settings(runs).items()]
    legend = [markdown_table(["variant", "settings"], settings)] if settings else []
    return "\n\n".join(
        ["## Figures", NOTES, *tables, *legend, "### Run by run", markdown_table(*run_grid(runs))]
    )


def faults_markdown(faults: Sequence[Fault]) -> str:
    """Returns the list of what gave no result; empty when all did."""
    lines = [f"- **{fault.what}**: {fault.reason}" for fault in faults]
    return "\n".join(["## Without a result", "", *lines]) if lines else ""
