"""The page a person looks at first: tables and pictures of one run, as `report.md` in its folder."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from occfusion.files.atomic import write_bytes
from occfusion.files.run_folder import METRICS, STAGES, RunFolder, read_json
from occfusion.files.table import read_table
from occfusion.report.drawing import panels, plain_numbers, png
from occfusion.report.tables import figure, figures_known, heading, run_title

REGION_NOTES = {
    "full": "held-out cameras, whole frame over black",
    "box": "held-out cameras, the person's padded box",
    "visible": "training views, the part of the person that was seen",
    "hidden": "training views, the part of the person that was occluded",
    "seen_many": "held-out cameras, where training saw the body from many directions",
    "seen_one": "held-out cameras, where it saw the body from one direction",
    "unseen": "held-out cameras, where it never saw the body",
}
NOT_LOSSES = ("stage", "step", "gaussians")
SMOOTHED = 50
"""Steps that a point of a loss curve is the mean of: each step sees another frame."""
PANELS_A_ROW = 3


def write_report(folder: RunFolder) -> Path:
    """Writes the report of a run, with pictures of its error curve and losses where it has them; returns its path.

    Raises:
        CheckpointError: the folder has no readable figures, which the end of a run writes.
    """
    metrics, curve, losses = folder.read_metrics(), _numbers(folder.curve, METRICS), _numbers(folder.losses)
    plan = read_json(folder.plan) if folder.plan.is_file() else None
    environment = read_json(folder.environment) if folder.environment.is_file() else None
    sections = [_head(metrics), _figures(metrics, folder)]
    if curve:
        name, picture = metrics["perceptual_metric"], folder.curve.with_suffix(".png")
        plot_error_vs_time(curve, picture, name)
        sections.append(_curve(curve, name, picture.name))
    picture = folder.losses.with_suffix(".png")
    if plot_losses(losses, picture):
        sections.append(_losses(folder.losses.name, picture.name))
    sections.append(_pictures(folder.pictures))
    if plan is not None:
        sections.append(_plan(plan))
    if environment is not None:
        sections.append(_environment(environment))
    write_bytes(folder.report, ("\n\n".join(s for s in sections if s) + "\n").encode())
    return folder.report


def _numbers(path: Path, columns: Sequence[str] = ()) -> list[dict[str, str]]:
    """Returns the rows of a table of stages, in the order of those; none, which is said, where it is damaged."""
    try:
        rows = read_table(path)
        for row in rows:
            if None in row or None in row.values():
                raise ValueError("a row of another length")
            int(row["step"])
            if lacking := [column for column in columns if column not in row]:
                raise ValueError(f"no column {lacking[0]}")
            if not all(math.isfinite(float(value)) for key, value in row.items() if key != "stage" and value):
                raise ValueError("a figure that is not finite")
            if row["stage"] not in STAGES:
                raise ValueError(f"no stage {row['stage']!r}")
    except (KeyError, TypeError, ValueError) as error:
        print(f"{path} is damaged, and left out of the report ({error})")
        return []
    # one that was made again stands behind later ones
    return sorted(rows, key=lambda row: STAGES.index(row["stage"]))


def plot_error_vs_time(
    rows: Sequence[Mapping[str, str]], picture: Path | str, perceptual_metric: str | None = None
) -> None:
    """Draws an error curve: one panel a metric, one line a stage, over training seconds.

    Args:
        rows: of its table.
        picture: the PNG to write.
        perceptual_metric: the name of what the `lpips` column holds.
    """
    shown = [m for m in METRICS if any(row[m] for row in rows)]
    drawing, axes_of = panels(len(shown), len(shown), 2.8, below=0.2)
    for metric, axes in zip(shown, axes_of, strict=True):
        for stage in dict.fromkeys(row["stage"] for row in rows):
            measured = [row for row in rows if row["stage"] == stage and row[metric]]
            seconds = [float(row["train_seconds"]) for row in measured]
            axes.plot(
                seconds, [float(row[metric]) for row in measured], marker="o", markersize=3, label=stage
            )
        axes.set_title(heading(metric, perceptual_metric).removesuffix(" x1000"), fontsize=10)
        axes.set_xlabel("training seconds")
        axes.set_xscale("symlog", linthresh=1.0)  # measured at 0, t, 2t, 4t, ...
        plain_numbers(axes.xaxis)
    if shown:
        drawing.axes[0].legend(fontsize=8)
    write_bytes(picture, png(drawing))


def plot_losses(rows: Sequence[Mapping[str, str]], picture: Path | str) -> bool:
    """Draws the losses: a panel a term and one for the weighted sum, a line a stage, over the steps of all stages.

    Args:
        rows: of the table.
        picture: the PNG to write.

    Returns:
        Whether there was anything to draw.
    """
    columns = rows[0] if rows else ()
    terms = [name for name in columns if name not in NOT_LOSSES and not name.startswith("rate_")]
    if not terms:
        return False
    drawing, axes_of = panels(len(terms), PANELS_A_ROW, 2.4)
    stages = list(dict.fromkeys(row["stage"] for row in rows))
    last = {stage: max(int(row["step"]) for row in rows if row["stage"] == stage) for stage in stages}
    for term, axes in zip(terms, axes_of, strict=True):
        before, is_positive = 0, True
        for stage in stages:
            steps, values = _smoothed([row for row in rows if row["stage"] == stage], term, before)
            axes.plot(steps, values, linewidth=1, label=stage)
            is_positive = is_positive and all(value > 0.0 for value in values)
            before += last[stage]
        axes.set_title("weighted sum" if term == "total" else term, fontsize=10)
        axes.set_yscale("log" if is_positive else "linear")
        axes.set_xlim(0, before)
        plain_numbers(axes.yaxis)
    drawing.axes[0].legend(fontsize=8)
    write_bytes(picture, png(drawing))
    return True


def _smoothed(rows: Sequence[Mapping[str, str]], term: str, before: int) -> tuple[list[float], list[float]]:
    """Returns steps and values of a term: means over parts of `SMOOTHED` steps of a stage that began at `before`."""
    parts: dict[int, list[tuple[int, float]]] = {}
    for row in rows:
        if row[term]:
            parts.setdefault((int(row["step"]) - 1) // SMOOTHED, []).append(
                (int(row["step"]), float(row[term]))
            )
    steps = [before + sum(step for step, _ in part) / len(part) for part in parts.values()]
    return steps, [sum(value for _, value in part) / len(part) for part in parts.values()]


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a Markdown table; the first column is aligned to the left, the others to the right."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _head(metrics: Mapping[str, Any]) -> str:
    seconds = metrics["train_seconds"]
    parts = ", ".join(
        f"{stage} {seconds[stage]:.1f}" for stage in seconds if seconds[stage] and stage != "total"
    )
    return (
        f"# {run_title(metrics)}\n\n"
        f"Trained in {seconds['total'] or 0.0:.1f} s ({parts or 'nothing trained'}); "
        f"{metrics['gaussians']} Gaussians; peak memory {metrics['peak_memory_mb']:.0f} MB; "
        f"evaluated on {metrics['images']} held-out images."
    )


def _figures(metrics: Mapping[str, Any], folder: RunFolder) -> str:
    name = metrics["perceptual_metric"]
    rows, capped, shown = [], 0, figures_known(metrics)
    for region, values in metrics["regions"].items():
        note = REGION_NOTES.get(region, "")
        images = values.get("images")
        capped += values.get("psnr_capped", 0)
        cells = [figure(metric, values.get(metric)) for metric in shown]
        rows.append([f"{region}: {note}", "-" if images is None else str(images), *cells])
    table = markdown_table(["region", "images", *(heading(metric, name) for metric in shown)], rows)
    notes = [
        f"A dash is a figure that could not be computed. Every image counts the same; see `{folder.per_image.name}`."
    ]
    if metrics.get("camera_gain", "none") != "none":
        notes.append(
            "Colours of each held-out camera are multiplied by a gain a channel, fitted to its own pictures "
            f"(`camera_gains` in `{folder.metrics.name}`)."
        )
    if capped:
        notes.append(f"{capped} images reached the cap of the PSNR, 100 dB.")
    return f"## Figures\n\n{table}\n\n{' '.join(notes)}"


def _curve(rows: Sequence[Mapping[str, str]], name: str | None, picture: str) -> str:
    header = ["stage", "step", "seconds", *(heading(metric, name) for metric in METRICS), "Gaussians"]
    body = []
    for row in rows:
        cells = [figure(metric, float(row[metric]) if row[metric] else None) for metric in METRICS]
        body.append(
            [row["stage"], row["step"], f"{float(row['train_seconds']):.1f}", *cells, row["gaussians"]]
        )
    return (
        "## Error against training time\n\nOn a fixed handful of held-out images; the clock stands "
        "still while they are measured.\n\n"
        f"![error against time]({picture})\n\n{markdown_table(header, body)}"
    )


def _losses(table: str, picture: str) -> str:
    return (
        f"## Losses\n\nEach point is a mean of {SMOOTHED} steps; every step is in `{table}`.\n\n"
        f"![losses]({picture})"
    )


def _pictures(folder: Path) -> str:
    files = sorted(file for file in folder.glob("*.*") if file.suffix in (".png", ".webp"))
    links = [
        f"### {file.stem.replace('_', ' ')}\n\n![{file.stem}]({folder.name}/{file.name})" for file in files
    ]
    return "## Pictures\n\n" + "\n\n".join(links) if links else ""


def _plan(plan: Mapping[str, Any]) -> str:
    rows = [[d["part"], "yes" if d["used"] else "no", d["reason"]] for d in plan["decisions"]]
    return "## What was done and what was left out\n\n" + markdown_table(["part", "used", "why"], rows)


def _environment(environment: Mapping[str, Any]) -> str:
    keys = ("command", "date", "processor", "cores", "threads", "accelerator", "python", "git_revision")
    rows = [
        [key.replace("_", " "), str(environment[key])] for key in keys if environment.get(key) is not None
    ]
    packages = environment.get("packages", {})
    rows += [[name, version] for name, version in packages.items() if version is not None]
    return "## Where and with what\n\n" + markdown_table(["", ""], rows)
