"""Stops runs at random moments by SIGKILL, SIGTERM and SIGINT, continues them, and compares with an uninterrupted one.

`python scripts/stop_at_random.py --stops 200`: a run is stopped again and again by the same command until it comes to
its end; its tensors, pictures and figures of each image must be those of the uninterrupted run, bit by bit, on a CPU.
Rows are kept in `stops.csv` of `--place` as they come, and the same command goes on with them. Exits with 1 where a run
is another one, or a signal ended with another exit code than its own.
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import traceback
from pathlib import Path

from safetensors.torch import load_file

ROOT = Path(__file__).parents[1]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
CLEAN = {signal.SIGKILL: {-9}, signal.SIGTERM: {143, -15}, signal.SIGINT: {130, -2}}
"""Exit codes that a stop may end with; a signal before Python has begun ends the process itself."""
SPAN = 0.7
"""Share of the time of a whole run within which it is stopped; most go on from what an earlier stop left."""
STAGES, PICTURES = ("optim", "refine"), ("masks", "inpainted")


def command(place: Path, name: str) -> list[str]:
    """Returns the command of a run on the tiny scene; each run shares with nobody."""
    return [
        sys.executable, str(ROOT / "train.py"), "dataset=zju", f"dataset.root={place}", "dataset.scene=001-clean",
        f"body.path={place}/001-clean/body.npz", "variant=E", "optim.steps=40", "refine.steps=20",
        "optim.lambda_lpips=0", "refine.lambda_lpips=0", "evaluation.perceptual=false", "evaluation.curve=false",
        "trainer.checkpoint_every=10", "trainer.accelerator=cpu",
        f"output_dir={place / name}", f"shared_dir={place / 'shared' / name}",
    ]  # fmt: skip


def preload() -> None:
    """Imports what runs import, so that processes forked from this one need not: most stops then fall into work."""
    sys.path[:0] = [str(ROOT / "src")]
    import occfusion.cli.train
    import occfusion.run.app  # noqa: F401


def run_until(place: Path, name: str, number: signal.Signals, after: float | None) -> tuple[int, bool, str]:
    """Runs in a forked process and sends it a signal after so many seconds; returns exit code, whether sent, output."""
    said = place / f"{name}.txt"
    child = os.fork()
    if child == 0:
        code = 1
        try:
            output = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(output, 1)
            os.dup2(output, 2)
            from occfusion.cli.train import find_config_dir
            from occfusion.cli.train import main as train

            sys.argv = command(place, name)[1:]
            try:
                code = train(find_config_dir())
            except BaseException:  # as Python would show it
                traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    ended, status, is_sent, began = 0, 0, False, time.monotonic()
    while not ended:
        time.sleep(0.01)
        if after is not None and not is_sent and time.monotonic() - began > after:
            os.kill(child, number)
            is_sent = True
        ended, status = os.waitpid(child, os.WNOHANG)
    return os.waitstatus_to_exitcode(status), is_sent, said.read_text()


def made(run: Path) -> dict[str, object]:
    """Returns all that must be the same however often a run was stopped: tensors, pictures, figures of each image."""
    found: dict[str, object] = {}
    for stage in STAGES:
        file = run / stage / "avatar.safetensors"
        tensors = load_file(file) if file.is_file() else {}
        found[stage] = {name: (value.shape, value.numpy().tobytes()) for name, value in tensors.items()}
    for folder in PICTURES:
        found[folder] = {path.name: path.read_bytes() for path in sorted((run / folder).glob("*.png"))}
    table = run / "per_image.csv"
    found[table.name] = table.read_bytes() if table.is_file() else None
    return found


def prepare(place: Path) -> float:
    """Writes the scene and two uninterrupted runs where they are missing; returns the seconds that a run takes."""
    clock = place / "seconds.txt"
    if clock.is_file():
        return float(clock.read_text())
    shutil.rmtree(place, ignore_errors=True)
    written = [
        sys.executable, "-m", "occfusion", "synth", str(place), "--size", "64", "--frames", "4", "--cameras", "2",
    ]  # fmt: skip
    subprocess.run(
        written, check=True, env={**os.environ, "PYTHONPATH": str(ROOT / "src")}, stdout=subprocess.DEVNULL
    )
    for name in ("whole", "again"):  # the first compiles what the second finds
        began = time.monotonic()
        code, _, said = run_until(place, name, signal.SIGKILL, None)
        if code != 0:
            raise SystemExit(said)
        seconds = time.monotonic() - began
    if made(place / "whole") != made(place / "again"):
        raise SystemExit("two runs that nobody stopped differ: no stop can be judged by them")
    clock.write_text(f"{seconds:.2f}\n")
    return seconds


def main() -> int:
    """Stops and compares; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--stops", type=int, default=200, help="in all, with those that the place has (%(default)s)"
    )
    parser.add_argument("--each", type=int, default=5, help="stops of one run at most")
    parser.add_argument("--place", type=Path, default=Path("runs/stops"), help="goes on with what it has")
    args = parser.parse_args()
    place = args.place.absolute()
    preload()
    seconds = prepare(place)
    expected, table = made(place / "whole"), place / "stops.csv"
    rows = list(csv.DictReader(table.open())) if table.is_file() else []
    while sum(int(row["stops"]) for row in rows) < args.stops:
        name = f"stopped-{len(rows) + 1}"
        shutil.rmtree(
            place / name, ignore_errors=True
        )  # a script that was stopped itself begins this run anew
        shutil.rmtree(place / "shared" / name, ignore_errors=True)
        chance, signals, faults = random.Random(len(rows)), [], []
        for _ in range(min(args.each, args.stops - sum(int(row["stops"]) for row in rows))):
            number = chance.choice(SIGNALS)
            code, sent, said = run_until(place, name, number, chance.uniform(0.0, SPAN * seconds))
            if sent:
                signals.append(number.name)
                if code not in CLEAN[number] | {0}:
                    faults.append(f"{number.name} ended with {code}: {said[-400:]}")
            if "Traceback" in said:
                faults.append(f"traceback: {said[-400:]}")
            if code == 0:
                break
        _, _, said = run_until(place, name, signal.SIGKILL, None)
        found = made(place / name)
        faults += [
            f"{part} is another one: {said[-400:]}"
            for part, value in expected.items()
            if found[part] != value
        ]
        rows.append(
            {
                "run": name,
                "stops": str(len(signals)),
                "signals": " ".join(signals),
                "faults": "; ".join(faults),
            }
        )
        with table.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        if not faults:
            shutil.rmtree(place / name, ignore_errors=True)
            shutil.rmtree(place / "shared" / name, ignore_errors=True)
        bad = sum(bool(row["faults"]) for row in rows)
        print(
            f"{sum(int(row['stops']) for row in rows)} stops, {len(rows)} runs, {bad} with faults", flush=True
        )
    print("\n".join(row["faults"] for row in rows if row["faults"]))
    return int(any(row["faults"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
