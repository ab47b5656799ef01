"""`python -m occfusion replay FILE`: one step alone, as it was when it was not finite; exits with 1 where it is not."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument("file", type=Path, metavar="FILE", help="the kept step in a stage's folder of a run")


def run(args: argparse.Namespace) -> int:
    """Repeats the step; returns the exit code."""
    # Lightning is loaded where it is used: seconds, which the explanation does not need
    from occfusion.run.replay import replay

    found = replay(args.file)
    if not found.same_frame:
        print(f"the data have changed: frame {found.frame} is not the one that was kept in {args.file}")
    print(f"was: {found.was}")
    print(
        f"now: {found.now or f'stage {found.stage}, step {found.step}: finite; the same training command continues'}"
    )
    return int(found.now is not None)
