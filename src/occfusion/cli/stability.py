"""`python -m occfusion stability`: sweeps stiff and extreme cases; exits with 1 where one exceeds its bound."""

from __future__ import annotations

import argparse
import sys
import time
from functools import partial
from pathlib import Path

import torch

from occfusion.errors import ConfigError
from occfusion.files.atomic import make_writable
from occfusion.run.environment import describe_environment
from occfusion.settings.stages import RateSettings
from occfusion.stability.axes import Row, sweep
from occfusion.stability.motion import motion_axes
from occfusion.stability.page import summary, write_sweep
from occfusion.stability.pictures import picture_axes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument(
        "--output", type=Path, default=Path("runs/stability"), metavar="DIR", help="(%(default)s)"
    )
    parser.add_argument("--quick", action="store_true", help="a few places of each axis, less than a minute")
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--axes", nargs="+", metavar="WORD", help="those with one of these words in their name (all)"
    )
    what.add_argument(
        "--optimisation",
        action="store_true",
        help="in place of the sweep: how stiff the optimisation is, on embedded scenes and on problems with a known "
        "optimum",
    )
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), default="cpu", help="of the rasteriser (%(default)s)"
    )


def run(args: argparse.Namespace) -> int:
    """Sweeps and writes; returns the exit code."""
    if args.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "--device cuda: torch finds no CUDA device; leave the option out to sweep on the CPU"
        )
    make_writable(args.output)  # a sweep of half an hour is not to end at this
    if args.optimisation:
        # Lightning is loaded where it is used: seconds, which neither the sweep nor the explanation needs
        from occfusion.stability.optimisation import study

        tell = partial(print, file=sys.stderr, flush=True)
        study(args.output, vars(RateSettings()), describe_environment(), quick=args.quick, tell=tell)
        print(f"written to {args.output}")
        return 0
    known = [*motion_axes(), *picture_axes(torch.device(args.device))]
    axes = [axis for axis in known if args.axes is None or any(word in axis.name for word in args.axes)]
    if not axes:
        raise ConfigError(f"--axes {' '.join(args.axes)}: there are {'; '.join(axis.name for axis in known)}")
    rows: list[Row] = []
    for axis in axes:
        started = time.monotonic()
        found = sweep(axis, quick=args.quick)
        rows += found
        told = summary(found).replace(" on 1 axes", "")
        print(f"{axis.name}: {told} ({time.monotonic() - started:.1f} s)", file=sys.stderr, flush=True)
    write_sweep(args.output, rows, describe_environment())
    bad = [row for row in rows if row.verdict != "holds"]
    for row in bad:
        print(f"{row.axis} at {row.place:g}, {row.method}: {row.verdict} ({row.error}, {row.gradient_error})")
    print(f"{summary(rows)}; written to {args.output}")
    return int(bool(bad))
