"""The picture of the table of losses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from occfusion.files.atomic import write_bytes
from occfusion.report.drawing import panels, plain_numbers, png

NOT_LOSSES = ("stage", "step", "gaussians")
SMOOTHED = 50
"""Steps that a point of a loss curve is the mean of: each step sees another frame."""
PANELS_A_ROW = 3


def plot_losses(rows: Sequence[Mapping[str, str]], picture: Path | str) -> bool:
    """Draws the losses: a panel a term and one for the weighted sum, a line a stage, over the steps of all stages.

    Args:
        rows: of the table.
        picture: the PNG to write.

    Returns:
        Whether there was anything to draw.
    """
    terms = (
        [name for name in rows[0] if name not in NOT_LOSSES and not name.startswith("rate_")] if rows else []
    )
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
