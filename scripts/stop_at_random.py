"""Stops runs at random moments by SIGKILL, SIGTERM and SIGINT, continues them, and compares with an uninterrupted one.

`python scripts/stop_at_random.py --stops 200`: a run is stopped again and again by the same command until it comes to
its end; its tensors must be those of the uninterrupted run, bit by bit, on a CPU. Exits with 1 where one is not.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch
from safetensors.torch import load_file

ROOT = Path(__file__).parents[1]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
CLEAN = {signal.SIGKILL: {-9}, signal.SIGTERM: {143, -15}, signal.SIGINT: {130, -2}}
"""Exit codes that a stop may end with; a signal before Python has begun ends the process itself."""
STAGES = ("optim", "refine")


def command(place: Path, name: str) -> list[str]:
    """Returns the command of a run on the tiny scene; each run shares with nobody."""
    return [
        sys.executable, str(ROOT / "train.py"), "dataset=zju", f"dataset.root={place}", "dataset.scene=001-clean",
        f"body.path={place}/001-clean/body.npz", "variant=E", "optim.steps=40", "refine.steps=20",
        "optim.lambda_lpips=0", "refine.lambda_lpips=0", "evaluation.perceptual=false", "evaluation.curve=false",
        "trainer.checkpoint_every=10", "trainer.accelerator=cpu",
        f"output_dir={place / name}", f"shared_dir={place / 'shared' / name}",
    ]  # fmt: skip


def start(place: Path, name: str) -> subprocess.Popen[str]:
    """Starts a run."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    return subprocess.Popen(
        command(place, name), env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def main() -> int:
    """Stops and compares; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stops", type=int, default=200)
    parser.add_argument("--each", type=int, default=5, help="stops of one run at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--place", type=Path, default=Path("runs/stops"))
    args = parser.parse_args()
    place, chance = args.place.absolute(), random.Random(args.seed)
    shutil.rmtree(place, ignore_errors=True)
    written = [
        sys.executable,
        "-m",
        "occfusion",
        "synth",
        str(place),
        "--size",
        "64",
        "--frames",
        "4",
        "--cameras",
        "2",
    ]
    subprocess.run(
        written, check=True, env={**os.environ, "PYTHONPATH": str(ROOT / "src")}, stdout=subprocess.DEVNULL
    )
    began = time.monotonic()
    whole = start(place, "whole")
    said, _ = whole.communicate()
    seconds = time.monotonic() - began
    if whole.returncode != 0:
        print(said)
        return 1
    expected = {stage: load_file(place / "whole" / stage / "avatar.safetensors") for stage in STAGES}
    stops, faults, runs = 0, [], 0
    while stops < args.stops:
        runs += 1
        name = f"stopped-{runs}"
        for _ in range(min(args.each, args.stops - stops)):
            process, number = start(place, name), chance.choice(SIGNALS)
            try:
                said, _ = process.communicate(timeout=chance.uniform(0.0, 1.1 * seconds))
            except subprocess.TimeoutExpired:
                process.send_signal(number)
                said, _ = process.communicate()
                stops += 1
                if process.returncode not in CLEAN[number] | {0}:
                    faults.append(
                        f"{name}: {signal.Signals(number).name} ended with {process.returncode}\n{said}"
                    )
            if process.returncode == 0:
                break
        process = start(place, name)
        said, _ = process.communicate()
        for stage in STAGES:
            file = place / name / stage / "avatar.safetensors"
            found = load_file(file) if file.is_file() else {}
            same = found.keys() == expected[stage].keys()
            if not same or not all(torch.equal(found[key], value) for key, value in expected[stage].items()):
                faults.append(f"{name}: {stage} is another one; {said[-400:]}")
        shutil.rmtree(place / name, ignore_errors=True)
        print(f"{stops} stops, {runs} runs, {len(faults)} faults", flush=True)
    print("\n".join(faults))
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
