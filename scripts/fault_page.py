"""The page of faults that were found by trying to break the program, from `tests/faults.csv`."""

from __future__ import annotations

import csv
from pathlib import Path

TABLE = Path(__file__).resolve().parents[1] / "tests" / "faults.csv"
HEAD = """# Faults that were found

What somebody found or suspected who tried to break the program, with signals, damaged files, bad input and hostile
ones; what it does in that case now; and the tests that hold it. The list is `tests/faults.csv`, this page follows from
it (`python scripts/write_reference_pages.py`), and the tests run with every change.

| fault | now | tests |
|---|---|---|
"""
FOOT = """
What is measured besides, by scripts that take too long for every change: [stops and damage](stops_and_damage.md).
"""


def faults() -> list[dict[str, str]]:
    """Returns the rows of the table."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def fault_page() -> str:
    """Returns the page: a row for each fault, under the kind of its first."""
    lines, kind = [], ""
    for fault in faults():
        if fault["kind"] != kind:
            kind = fault["kind"]
            lines.append(f"| **{kind}** | | |\n")
        tests = ", ".join(f"`{name.rpartition('/')[2]}`" for name in fault["test"].split())
        lines.append(f"| {fault['fault']} | {fault['behaviour']} | {tests} |\n")
    return HEAD + "".join(lines) + FOOT
