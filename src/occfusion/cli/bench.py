"""`python -m occfusion bench`: measures, prints tables, writes them with a CSV file and pictures."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import torch

from occfusion.bench.contestants import available_backends, backend, peers
from occfusion.bench.measure import BenchRow, Conditions, accuracy, precision, race, step
from occfusion.bench.plan import FULL, PARTS, QUICK, BenchPlan
from occfusion.bench.publish import draw_precision, draw_scaling, tables, write_csv
from occfusion.bench.steps import StepProfile, draw_steps, steps_text, write_steps
from occfusion.errors import ConfigError
from occfusion.files.atomic import make_writable, write_bytes
from occfusion.run.environment import describe_environment
from occfusion.splat.backends.registry import DEVICES

CPU = torch.device("cpu")


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
        "--threads",
        type=int,
        nargs="+",
        default=[1],
        metavar="N",
        help="threads of torch and of the backends (1); with several, steps are profiled with each of them, and all "
        "else is measured with the first",
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
    torch.set_num_threads(args.threads[0])
    profiles: list[StepProfile] = []
    try:
        for row in _measure(args, plan, device):
            if not rows or rows[-1].part != row.part:
                print(f"measuring {row.part}", file=sys.stderr, flush=True)
            rows.append(row)
        environment = describe_environment() | {"load": _load()}
        if "step" in args.parts:
            profiles = _profiles(args, plan)
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
    if profiles:
        write_steps(args.output / "step.csv", profiles)
        draw_steps(args.output / "step.png", profiles)
        text += f"\n{steps_text(profiles)}\n![a step, part by part](step.png)\n"
    write_bytes(args.output / "bench.md", text.encode())
    print(text)
    print(f"written to {args.output}")
    return 0


def _prepare(args: argparse.Namespace) -> torch.device:
    if min(args.threads) < 1:
        raise ConfigError(f"--threads {min(args.threads)}: at least 1 is needed")
    if args.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "--device cuda: torch finds no CUDA device; leave the option out to measure on the CPU"
        )
    device = torch.device(args.device)
    available_backends(device, args.backends)  # a name that is unknown is said before anything is written
    if "step" in args.parts:
        _backend_of_steps(args)
    return device


def _backend_of_steps(args: argparse.Namespace) -> str:
    """Returns what steps are measured with: they run on the CPU, whatever else does not."""
    wanted = args.backends and [name for name in args.backends if DEVICES.get(name) != "cuda"]
    if wanted == []:
        raise ConfigError(
            f"--backends {' '.join(args.backends)}: steps are measured on the CPU, where it does not run; add torch, "
            "or leave step out of --parts"
        )
    return available_backends(CPU, wanted)[-1]


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
        yield from step(_backend_of_steps(args), *plan.step, replace(conditions, device=CPU))


def _profiles(args: argparse.Namespace, plan: BenchPlan) -> list[StepProfile]:
    """Trains on an embedded scene, once for each size and number of threads, and returns the profiles."""
    from hydra import compose, initialize_config_dir

    from occfusion.cli.train import find_config_dir
    from occfusion.run.step_profile import profile_stages
    from occfusion.settings.schema import load_settings

    chosen = plan.run
    found: list[StepProfile] = []
    with (
        tempfile.TemporaryDirectory() as place,
        initialize_config_dir(str(find_config_dir()), version_base="1.3"),
    ):
        for size in chosen.sizes:
            for threads in args.threads:
                print(f"measuring steps, {size} px, {threads} threads", file=sys.stderr, flush=True)
                own = Path(place) / f"{size}-{threads}"
                overrides = [
                    f"dataset.root={place}/data-{size}", f"dataset.scene={chosen.scene}", f"dataset.image_size={size}",
                    f"dataset.frames={chosen.frames}", "dataset.cameras=2", f"seed={args.seed}", "logger=csv",
                    f"rasterizer={_backend_of_steps(args)}", f"output_dir={own}", f"shared_dir={own}/shared",
                    "trainer.enable_progress_bar=false", "trainer.accelerator=cpu",
                ]  # fmt: skip
                torch.set_num_threads(threads)
                settings = load_settings(compose("config", overrides))
                with redirect_stdout(sys.stderr):
                    found += profile_stages(settings, chosen.gaussians, chosen.rounds, chosen.block)
    return found


def _load() -> str:
    """Returns the machine's mean load over the last minute: others' work makes times worse than they are."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
