"""Measures how the cost of a run grows: with frames, pixels, Gaussians and cameras, one at a time.

    python scripts/measure_growth.py WORK             # measures what docs/results/growth.csv lacks
    python scripts/measure_growth.py WORK --page      # and draws the curves and writes the page from it

Each point is a process of its own, so that its memory is its own. Its scene is written first, by another, in
ZJU-MoCap's layout. What is measured: seconds from the beginning of the process to the first training step, processor
time of a step of both stages, and the largest resident memory. `E`, 003-hard, one thread.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import linear_regression

BEGAN = time.perf_counter(), time.process_time()
ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs/results"
SCENE = "003-hard"
AXES = {
    "frames": (100, 500, 2000),
    "size": (256, 512, 1024),
    "gaussians": (7_000, 15_000, 50_000),
    "cameras": (1, 23),
}
USUAL = {"frames": 100, "size": 256, "gaussians": 15_000, "cameras": 1}
FIGURES = ("start_seconds", "start_cpu", "optim_ms", "refine_ms", "peak_mb")
COLUMNS = ("axis", "asked", *USUAL, *FIGURES, "revision")
TITLES = {
    "start_seconds": "to the first step, s",
    "start_cpu": "of the processor",
    "optim_ms": "a step of `optim`, ms",
    "refine_ms": "of `refine`, ms",
    "peak_mb": "peak memory, MB",
}
BEGUN, ENDED = "<!-- measured -->", "<!-- /measured -->"
ROUNDS, BLOCK = 2, 16
ONE_THREAD = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@dataclass(frozen=True)
class Point:
    """What a run is of."""

    frames: int
    size: int
    gaussians: int
    cameras: int

    @property
    def data(self) -> str:
        """Name of the folder that holds its scene."""
        return f"{self.frames}-{self.size}-{self.cameras}"


def measure(work: Path, point: Point) -> dict[str, float]:
    """Returns the figures of a run in this process, which has done nothing else."""
    from occfusion.cpu.loading import loading

    with loading():  # as the command line does
        import torch
        from hydra import compose, initialize_config_dir

        from occfusion.cli.train import find_config_dir
        from occfusion.run import bodies
        from occfusion.run.step_profile import profile_stages
        from occfusion.settings.schema import load_settings
        from occfusion.stages.optim import OptimStage

    started: list[tuple[float, float]] = []
    usual_start = OptimStage.on_train_start

    def noted_start(stage: OptimStage) -> None:
        usual_start(stage)
        started.append((time.perf_counter() - BEGAN[0], time.process_time() - BEGAN[1]))

    OptimStage.on_train_start = noted_start  # type: ignore[assignment, method-assign]
    torch.set_num_threads(1)
    data = work / point.data
    own = work / "runs" / f"{point.data}-{point.gaussians}"
    shutil.rmtree(own, ignore_errors=True)  # a run that is finished would start nothing
    overrides = [
        "dataset=zju", f"dataset.root={data}", f"dataset.scene={SCENE}", f"dataset.image_size={point.size}",
        f"dataset.train_frames=[0,{point.frames},1]", "body=smpl", f"body.path={data / SCENE / 'body.npz'}",
        "logger=csv", "rasterizer=numba", f"output_dir={own}", f"shared_dir={own}/shared",
        "trainer.enable_progress_bar=false", "trainer.accelerator=cpu",
    ]  # fmt: skip
    with initialize_config_dir(str(find_config_dir()), version_base="1.3"):
        settings = load_settings(compose("config", overrides))
    looked_at = bodies.most_seen(settings)  # of a whole run, of which a few steps are timed
    bodies.most_seen = lambda _: looked_at  # type: ignore[assignment]
    profiles = list(profile_stages(settings, point.gaussians, ROUNDS, BLOCK))
    steps = {profile.stage: profile.measured.cpu for profile in profiles}
    return {
        "gaussians": profiles[-1].gaussians,
        "start_seconds": round(started[0][0], 2),
        "start_cpu": round(started[0][1], 2),
        "optim_ms": round(steps["optim"], 2),
        "refine_ms": round(steps["refine"], 2),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


def measure_missing(work: Path) -> None:
    """Measures what the CSV lacks, a process each, and adds its rows."""
    from occfusion.files.table import read_table, write_table

    table = RESULTS / "growth.csv"
    rows: list[dict[str, object]] = [dict(row) for row in read_table(table)] if table.is_file() else []
    revision = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True, cwd=ROOT
    ).stdout.strip()
    one_thread = {**os.environ, **dict.fromkeys(ONE_THREAD, "1")}
    for axis, amounts in AXES.items():
        for amount in amounts:
            wanted = {**USUAL, axis: amount}
            point = Point(**wanted)
            if any(row["axis"] == axis and int(str(row["asked"])) == amount for row in rows):
                continue
            same = [row for row in rows if all(int(str(row[k])) == v for k, v in wanted.items())]
            if same:  # the usual run is a point of several axes
                rows.append({**same[0], "axis": axis, "asked": amount})
                write_table(table, COLUMNS, rows)
                continue
            if not (work / point.data / SCENE).is_dir():
                made = ["synth", str(work / point.data), "--scene", SCENE, "--size", str(point.size)]
                made += ["--frames", str(point.frames), "--cameras", str(point.cameras), "--quiet"]
                subprocess.run([sys.executable, "-m", "occfusion", *made], check=True)
            told = subprocess.run(
                [sys.executable, __file__, str(work), "--point", json.dumps(vars(point))],
                check=True, stdout=subprocess.PIPE, text=True, env=one_thread,
            )  # fmt: skip
            figures = json.loads(told.stdout.splitlines()[-1])
            own = {"axis": axis, "asked": amount, **vars(point), **figures, "revision": revision}
            rows.append(own)
            write_table(table, COLUMNS, rows)
            print(rows[-1], flush=True)


def exponent(amounts: Sequence[float], costs: Sequence[float]) -> float:
    """Returns the slope of the line through logarithms, least squares: cost grows as amount to this power."""
    return linear_regression([math.log(a) for a in amounts], [math.log(c) for c in costs]).slope


def page(rows: Sequence[Mapping[str, str]]) -> str:
    """Returns a table for each axis, with the exponents of cost in its last row."""
    parts = []
    for axis in AXES:
        own = [row for row in rows if row["axis"] == axis]
        amounts = [float(row["gaussians"] if axis == "gaussians" else row["asked"]) for row in own]
        lines = [f"| {axis} | {' | '.join(TITLES.values())} |", "|---" * (1 + len(TITLES)) + "|"]
        for amount, row in zip(amounts, own, strict=True):
            lines.append(f"| {amount:.0f} | {' | '.join(f'{float(row[key]):.4g}' for key in FIGURES)} |")
        powers = (exponent(amounts, [float(row[key]) for row in own]) for key in FIGURES)
        lines.append(f"| exponent | {' | '.join(f'{power:.2f}' for power in powers)} |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def draw(rows: Sequence[Mapping[str, str]], target: Path) -> None:
    """Draws cost against each axis, both logarithmic, as shares of the cost at its least amount."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, places = pyplot.subplots(1, len(AXES), figsize=(14, 3.4), sharey=True)
    for axis, place in zip(AXES, places, strict=True):
        own = [row for row in rows if row["axis"] == axis]
        amounts = [float(row["gaussians"] if axis == "gaussians" else row["asked"]) for row in own]
        for key, title in TITLES.items():
            costs = [float(row[key]) for row in own]
            place.loglog(amounts, [cost / costs[0] for cost in costs], "o-", label=title)
        place.set_xlabel(axis)
        place.grid(alpha=0.3, which="both")
    places[0].set_ylabel("cost, over that of the least")
    places[-1].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(target, dpi=80)


def write_page() -> None:
    """Writes the tables into the page, and the picture."""
    from occfusion.files.table import read_table

    rows = read_table(RESULTS / "growth.csv")
    draw(rows, ROOT / "docs/pictures/growth.png")
    file = RESULTS / "growth.md"
    before, _, rest = file.read_text().partition(BEGUN)
    _, _, after = rest.partition(ENDED)
    file.write_text(f"{before}{BEGUN}\n{page(rows)}\n{ENDED}{after}")


def main() -> None:
    """Measures one point or all that is missing."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("--point", help=argparse.SUPPRESS)
    parser.add_argument("--page", action="store_true")
    args = parser.parse_args()
    if args.point:
        print(json.dumps(measure(args.work, Point(**json.loads(args.point)))))
    elif args.page:
        write_page()
    else:
        measure_missing(args.work)


if __name__ == "__main__":
    main()
