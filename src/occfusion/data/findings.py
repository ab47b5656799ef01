"""What a look into a data folder finds: one line each, with what to do about it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from occfusion.errors import OccfusionError

LEVELS = ("ok", "note", "doubt", "error")


@dataclass(frozen=True)
class Finding:
    """One line of the table.

    Attributes:
        level: `ok`; `note`: worth knowing; `doubt`: training starts, its result may suffer; `error`: training
            does not start.
        topic: what was looked at.
        text: what was found.
        cure: what to do; empty where there is nothing to do.
    """

    level: str
    topic: str
    text: str
    cure: str = ""


def worst(findings: Iterable[Finding]) -> str:
    """Returns the gravest level among findings."""
    return LEVELS[max((LEVELS.index(finding.level) for finding in findings), default=0)]


def guarded(topic: str, look: Callable[[], Iterable[Finding]]) -> list[Finding]:
    """Returns what `look` finds; an error that it raises becomes the last finding, and the rest can go on."""
    found: list[Finding] = []
    try:
        for finding in look():
            found.append(finding)
    except OccfusionError as error:
        found.append(Finding("error", topic, str(error)))
    return found


def listed(items: Iterable[object], most: int = 8) -> str:
    """Returns items as text, cut after the first few."""
    shown = list(items)
    more = f" and {len(shown) - most} more" if len(shown) > most else ""
    return ", ".join(str(item) for item in shown[:most]) + more
