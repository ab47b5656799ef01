"""Runs the tests of `tests/cases.csv` and writes `docs/reference/cases.md`: case, behaviour, tests, verdict."""

from __future__ import annotations

import csv
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

ROOT = Path(__file__).parents[1]
HEAD = """# Bad input, faults and extremes

The 46 cases that a run must survive, refuse or take exactly, each with the tests that show it, and what they said when
this page was made: `python scripts/write_case_table.py`.

| case | what | behaviour | tests | verdict |
|---|---|---|---|---|
"""


def main() -> int:
    """Runs and writes; returns pytest's exit code."""
    with (ROOT / "tests" / "cases.csv").open(newline="") as file:
        cases = list(csv.DictReader(file))
    names = sorted({name for case in cases for name in case["test"].split()})
    with tempfile.TemporaryDirectory() as place:
        report = Path(place) / "report.xml"
        options = ["-q", "-p", "no:cacheprovider", f"--junitxml={report}"]
        code = subprocess.run(
            [sys.executable, "-m", "pytest", *options, *names], cwd=ROOT, check=False
        ).returncode
        bad, seen = set(), set()
        for case in ET.parse(report).getroot().iter("testcase"):
            test = (
                f"{case.get('classname', '').rpartition('.')[2]}.py::{case.get('name', '').partition('[')[0]}"
            )
            seen.add(test)
            if case.find("failure") is not None or case.find("error") is not None:
                bad.add(test)
    lines = []
    for case in cases:
        short = [name.rpartition("/")[2] for name in case["test"].split()]
        verdict = "fails" if bad & set(short) else "passes" if set(short) <= seen else "not run"
        tests = ", ".join(f"`{name}`" for name in short)
        lines.append(f"| {case['case']} | {case['what']} | {case['behaviour']} | {tests} | {verdict} |\n")
    (ROOT / "docs" / "reference" / "cases.md").write_text(HEAD + "".join(lines), encoding="utf-8")
    return code


if __name__ == "__main__":
    sys.exit(main())
