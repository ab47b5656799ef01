"""Stops at random moments of all stages and of the evaluation: what is continued is what was not stopped."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest

from app.test_command_line import ENVIRONMENT, ROOT

STOPS = 20
EACH = 5  # of one command: where a first stop comes late, all others fall behind it


@pytest.mark.slow  # twenty stops take a second or two each; `scripts/stop_at_random.py` does two hundred
@pytest.mark.timeout(600)
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="Linux tells the time of other processes")
def test_twenty_stops_at_random(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "scripts" / "stop_at_random.py"), "--once", "--kinds", "run"]
    done = subprocess.run(
        [*command, "--stops", str(STOPS), "--each", str(EACH), "--place", str(tmp_path)],
        env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=590,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    with (tmp_path / "stops.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert sum(int(row["stops"]) for row in rows) == STOPS and not any(row["faults"] for row in rows)
    moments = {moment for row in rows for moment in row["moments"].split()}
    assert len(moments) >= 2, f"all stops fell into {moments}"
