"""Series smoothed over time; before its start a series is taken to be as at its start, and so at its end."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from occfusion.motion.clip import Array

REACH = 4.0
"""Standard deviations at which the bell is cut off."""


def smoothed(series: Array, deviation: float) -> Array:
    """Returns a series under a Gaussian bell.

    Args:
        series: `[T, ...]`.
        deviation: of the bell, steps.
    """
    radius = int(REACH * deviation + 0.5)
    bell = np.exp(-0.5 * (np.arange(-radius, radius + 1) / deviation) ** 2) if radius else np.ones(1)
    return np.asarray(_windows(series, radius, radius) @ (bell / bell.sum()))


def least_nearby(series: Array, window: int) -> Array:
    """Returns the least value within a window around each step.

    Args:
        series: `[T, ...]`.
        window: steps; of an even number there is one more before than after.
    """
    before = window // 2
    return np.asarray(_windows(series, before, window - 1 - before).min(axis=-1))


def _windows(series: Array, before: int, after: int) -> Array:
    """Returns what is around each step, `[T, ..., before + 1 + after]`."""
    beyond = [(before, after), *[(0, 0)] * (series.ndim - 1)]
    return sliding_window_view(np.pad(series, beyond, mode="edge"), before + 1 + after, axis=0)
