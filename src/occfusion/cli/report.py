"""`python -m occfusion report RUNS... --output FOLDER`: finished runs side by side, as HTML and Markdown."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from occfusion.compare.page import write_pages
from occfusion.compare.reading import find_runs, read_runs
from occfusion.errors import CheckpointError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUNS", help="run folders, or folders of them")
    parser.add_argument(
        "--output", type=Path, required=True, metavar="FOLDER", help="where report.html and report.md go"
    )


def run(arguments: argparse.Namespace) -> int:
    """Compares and writes; returns 0, or 1 when a folder is unfinished or damaged (the others are reported)."""
    runs, faults = read_runs(find_runs(arguments.runs))
    for fault in faults:
        print(f"no result: {fault.reason}", file=sys.stderr)
    if not runs:
        raise CheckpointError("none of the folders holds a finished run; nothing is written")
    for path in write_pages(arguments.output, runs, faults):
        print(path)
    return 1 if faults else 0
