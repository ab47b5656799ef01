"""Pictures of the studies: steps against condition, error against time."""

from __future__ import annotations

from collections.abc import Sequence

from occfusion.report.drawing import panels, plain_numbers, png
from occfusion.stability.axes import Row
from occfusion.stability.toys import Walk

HEIGHT, BELOW = 2.6, 0.25
"""Inches of a panel, and of the name of its axis under it."""


def draw_walks(found: Sequence[Walk]) -> bytes:
    """Returns a PNG: above, steps to the optimum against the condition; below, what is left against seconds.

    Where an optimiser does not come near in its steps, its point is hollow and stands at the last of them. Below, the
    worse the condition the fainter the line.
    """
    groups = list(dict.fromkeys(one.group for one in found))
    optimisers = list(dict.fromkeys(one.optimiser for one in found))
    figure, axes = panels(2 * len(groups), len(groups), HEIGHT, BELOW)
    for column, group in enumerate(groups):
        above, below = axes[column], axes[len(groups) + column]
        for number, optimiser in enumerate(optimisers):
            own = [one for one in found if (one.group, one.optimiser) == (group, optimiser)]
            color = f"C{number}"
            steps = [one.steps or one.curve[-1][0] for one in own]
            above.plot([one.condition for one in own], steps, "-", color=color, label=optimiser)
            for one, count in zip(own, steps, strict=True):
                above.plot(
                    [one.condition], [count], "o", color=color, mfc=color if one.steps else "white", ms=4
                )
            for k, one in enumerate(own):
                each = one.seconds / max(one.steps or one.curve[-1][0], 1)
                line = [(each * count, max(left, 1e-8)) for count, left in one.curve if count]
                below.plot(*zip(*line, strict=True), color=color, alpha=1.0 - 0.7 * k / max(len(own) - 1, 1))
        for panel in (above, below):
            panel.set_xscale("log")
            panel.set_yscale("log")
            plain_numbers(panel.xaxis)
            plain_numbers(panel.yaxis)
        above.set_title(f"{group}: steps", fontsize=9)
        above.set_xlabel("condition", fontsize=8)
        below.set_title("share of the distance left", fontsize=9)
        below.set_xlabel("seconds of one problem", fontsize=8)
        if column == 0:
            above.legend(fontsize=6)
    return png(figure)


def draw_error_vs_time(rows: Sequence[Row]) -> bytes:
    """Returns a PNG with a panel an axis: the error of gradients against the time of a call, from place to place.

    A dot is a place; the larger, the further along the axis. Errors of nothing are drawn at 1e-17.
    """
    names = list(dict.fromkeys(row.axis for row in rows))
    figure, axes = panels(len(names), 4, HEIGHT, BELOW)
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
        panel.set_xscale("log")
        panel.set_yscale("log")
        plain_numbers(panel.xaxis)
        plain_numbers(panel.yaxis)
        panel.set_title(name, fontsize=8)
        panel.set_xlabel("ms", fontsize=8)
        panel.legend(fontsize=6)
    return png(figure)
