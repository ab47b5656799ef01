"""The catalogue of bad inputs, faults and extremes: each of its 46 cases has a test, and each fault that was found."""

from __future__ import annotations

import ast
import csv
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]


def cases() -> list[dict[str, str]]:
    with (ROOT / "tests" / "cases.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@cache
def names_in(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {
        node.name for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }


def test_every_case_has_tests_that_are_there() -> None:
    assert [int(case["case"]) for case in cases()] == list(range(1, 47))
    for case in cases():
        assert case["test"].split(), case
        for name in case["test"].split():
            path, _, function = name.partition("::")
            assert function in names_in(ROOT / path), name


def test_every_fault_that_was_found_has_tests_that_are_there() -> None:
    with (ROOT / "tests" / "faults.csv").open(newline="") as file:
        faults = list(csv.DictReader(file))
    assert len(faults) > 50
    for fault in faults:
        assert (
            all(fault[column] for column in ("kind", "fault", "behaviour", "test")) and None not in fault
        ), fault
        for name in fault["test"].split():
            path, _, function = name.partition("::")
            assert function in names_in(ROOT / path), name


def test_the_page_is_that_of_the_table() -> None:
    page = (ROOT / "docs" / "reference" / "cases.md").read_text(encoding="utf-8")
    for case in cases():
        assert f"| {case['case']} | {case['what']} | {case['behaviour']} |" in page
        assert all(f"`{name.rpartition('/')[2]}`" in page for name in case["test"].split())
