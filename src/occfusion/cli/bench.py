"""`python -m occfusion bench`: measures, prints tables, writes them with a CSV file and pictures."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from occfusion.bench.contestants import available_backends, backend, peers
from occfusion.bench.draw import draw_precision, draw_scaling
from occfusion.bench.measure import BenchRow, Conditions, accuracy, precision, race, step
from occfusion.bench.plan import FULL, PARTS, QUICK, BenchPlan
from occfusion.bench.publish import tables, write_csv
from occfusion.errors import ConfigError
from occfusion.files.atomic import make_writable, write_bytes
from occfusion.run.environment import describe_environment


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument(
        "--output", type=Path, default=Path("runs/bench"), metavar="DIR", help="(%(default)s)"
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="what to measure (all)")
    parser.add_argument(
        "--backends", nargs="+", metavar="NAME", help="rasteriser backends (all that run here)"
    )
    parser.add_argument(
        "--threads", type=int, default=1, help="threads of torch and of the backends (%(default)s)"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="(%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the scenes (%(default)s)")
    parser.add_argument(
        "--quick", action="store_true", help="tiny scenes and few rounds: does it run at all?"
    )


def run(args: argparse.Namespace) -> int:
    """Measures and writes; returns the exit code."""
    device = _prepare(args)
    make_writable(args.output)
    plan = QUICK if args.quick else FULL
    rows: list[BenchRow] = []
    before = torch.get_num_threads()
    torch.set_num_threads(args.threads)
    try:
        for row in _measure(args, plan, device):
            if not rows or rows[-1].part != row.part:
                print(f"measuring {row.part}", file=sys.stderr, flush=True)
            rows.append(row)
        environment = describe_environment() | {"load": _load()}
    finally:
        torch.set_num_threads(before)
    text = tables(rows, environment)
    write_csv(args.output / "bench.csv", rows)
    if "scaling" in args.parts:
        draw_scaling(args.output / "scaling.png", rows)
        text += "\n![scaling](scaling.png)\n"
    if "precision" in args.parts:
        draw_precision(args.output / "precision.png", rows)
        text += "\n![work and precision](precision.png)\n"
    write_bytes(args.output / "bench.md", text.encode())
    print(text)
    print(f"written to {args.output}")
    return 0


def _prepare(args: argparse.Namespace) -> torch.device:
    if args.threads < 1:
        raise ConfigError(f"--threads {args.threads}: at least 1 is needed")
    if args.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "--device cuda: torch finds no CUDA device; leave the option out to measure on the CPU"
        )
    return torch.device(args.device)


def _measure(args: argparse.Namespace, plan: BenchPlan, device: torch.device) -> Iterator[BenchRow]:
    conditions = Conditions(device, args.seed, plan.seconds, plan.least_rounds)
    names = available_backends(device, args.backends)
    ours = [backend(name) for name in names]
    others = peers() if device.type == "cpu" else []
    if "speed" in args.parts:
        if others:
            # they take seconds to minutes a call on the scenes of the other races
            yield from race("speed", plan.accuracy[:1], [*ours, *others], conditions)
        yield from race("speed", plan.speed, ours, conditions)
    if "accuracy" in args.parts:
        precise = [backend("torch", torch.float64)] if "torch" in names else []
        yield from accuracy(plan.accuracy[:1], [*precise, *ours, *others], conditions)
        yield from accuracy(plan.accuracy[1:], [*precise, *ours], conditions)
    if "precision" in args.parts:
        yield from precision(plan.precision, [n for n in names if n != "gsplat"], conditions)
    if "scaling" in args.parts:
        for axis, sizes in plan.scaling.items():
            yield from race(f"scaling {axis}", sizes, ours, conditions)
    if "step" in args.parts:
        yield from step(names[-1], *plan.step, replace(conditions, device=torch.device("cpu")))


def _load() -> str:
    """Returns the machine's mean load over the last minute: others' work makes times worse than they are."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
