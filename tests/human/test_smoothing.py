"""Smoothing of a motion over time, against scipy's filters."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from occfusion.motion.performance import least_nearby, smoothed


@pytest.mark.parametrize("steps", [1, 2, 7, 120])
@pytest.mark.parametrize("deviation", [0.1, 0.25, 3.0, 15.0])
def test_smoothing_is_scipys(steps: int, deviation: float) -> None:
    series = np.random.default_rng(steps).normal(size=(steps, 3))
    expected = gaussian_filter1d(series, deviation, axis=0, mode="nearest")
    assert np.allclose(smoothed(series, deviation), expected, atol=1e-12)
    assert np.allclose(smoothed(series[:, 0], deviation), expected[:, 0], atol=1e-12)


@pytest.mark.parametrize("steps", [1, 2, 7, 120])
@pytest.mark.parametrize("window", [1, 2, 5, 60, 61])
def test_the_least_nearby_is_scipys(steps: int, window: int) -> None:
    series = np.random.default_rng(window).normal(size=steps)
    assert np.array_equal(least_nearby(series, window), minimum_filter1d(series, window, mode="nearest"))


def test_what_stands_still_stays() -> None:
    still = np.full((9, 3), 1.5)
    assert np.allclose(smoothed(still, 4.0), still) and np.array_equal(least_nearby(still, 4), still)
