"""Curves as a PNG; panels are laid out by hand: the libraries' own layout and mathematical text take seconds."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANEL_WIDTH = 3.6
"""Inches."""
PANEL_HEIGHT, BELOW = 2.6, 0.25
"""Inches of a panel of the studies, and of the name of its axis under it."""
LEFT, RIGHT, TOP, BOTTOM = 0.6, 0.22, 0.3, 0.3
"""Inches about each panel, for its numbers and its title."""


def panels(count: int, columns: int, height: float, below: float = 0.0) -> tuple[Figure, list[Axes]]:
    """Returns a figure with so many panels.

    Args:
        count: of the panels.
        columns: panels a row.
        height: of a panel with its margins, inches.
        below: more room under each panel, for the name of its axis, inches.
    """
    from matplotlib.figure import Figure

    columns = max(min(columns, count), 1)
    rows = max(-(-count // columns), 1)
    height += below
    width, tall = PANEL_WIDTH * columns, height * rows
    figure = Figure(figsize=(width, tall))
    axes = []
    for k in range(count):
        row, column = divmod(k, columns)
        left, low = PANEL_WIDTH * column + LEFT, tall - height * (row + 1) + BOTTOM + below
        size = (PANEL_WIDTH - LEFT - RIGHT, height - BOTTOM - TOP - below)
        axes.append(figure.add_axes((left / width, low / tall, size[0] / width, size[1] / tall)))
        axes[-1].grid(alpha=0.3)
    return figure, axes


def new_figure(width: float, height: float) -> Figure:
    """Returns an empty figure that lays itself out; sides in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def plain_numbers(axis: Any) -> None:
    """Gives an axis few ticks, with numbers as text without mathematical signs."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    if axis.get_scale() == "log":
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1.0,) if high > 1e3 * low else (1.0, 2.0, 5.0), numticks=6))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def make_logarithmic(panel: Axes) -> None:
    """Gives a panel two logarithmic axes with plain numbers."""
    panel.set(xscale="log", yscale="log")
    plain_numbers(panel.xaxis)
    plain_numbers(panel.yaxis)


def png(figure: Figure) -> bytes:
    """Returns the figure as a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
