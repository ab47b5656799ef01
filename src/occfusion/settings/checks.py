"""Checks of single settings: each names the setting and what is allowed."""

from __future__ import annotations

import math

from occfusion.errors import ConfigError


def check_in(key: str, value: str, allowed: tuple[str, ...]) -> None:
    """Refuses what is not among the choices.

    Raises:
        ConfigError: with the choices.
    """
    if value not in allowed:
        raise ConfigError(f"setting {key}: {value!r} is not one of {', '.join(allowed)}")


def check_range(key: str, value: float, low: float, high: float) -> None:
    """Refuses what is outside a range, ends included, or not finite.

    Raises:
        ConfigError: with the range.
    """
    # written so that NaN is refused as well
    if not low <= value <= high or math.isinf(value):
        raise ConfigError(f"setting {key}: {value} is outside the allowed range {low} to {high}")
