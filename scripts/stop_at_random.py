"""Stops runs at random moments by SIGKILL, SIGTERM and SIGINT, continues them, and compares with uninterrupted ones.

`python scripts/stop_at_random.py --stops 200`: a command is stopped again and again, and the same command goes on,
until it comes to its end; what it made must be what the uninterrupted command made, bit by bit, on a CPU. Commands of
four kinds take turns: a run of all stages with its evaluation, the training of a prior with its corpus
(`stage=prior`), a multirun, and the writing of a scene. Rows are kept in `stops.csv` of `--place` as they come, and
the same command goes on with them. Exits with 1 where what was made is another thing, a signal ended with another exit
code than its own, or a traceback was shown.
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from safetensors.torch import load_file

ROOT = Path(__file__).parents[1]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
CLEAN = {signal.SIGKILL: {-9}, signal.SIGTERM: {143, -15}, signal.SIGINT: {130, -2}}
"""Exit codes that a stop may end with; a signal before Python has begun ends the process itself."""
SPAN = 0.7
"""Share of a whole command's processor time within which it is stopped; most go on from what an earlier stop left."""
KINDS = ("run", "prior", "multirun", "scene")
COLUMNS = ("kind", "number", "stops", "signals", "moments", "faults")
KEPT = (
    "*.safetensors",
    "masks/*.png",
    "inpainted/*.png",
    "regions/*.png",
    "per_image.csv",
    "losses.csv",
    "*.ply",
    "001-clean/**/*.*",
)
"""What must be the same however often a command was stopped, by the ends of its paths."""


def command(place: Path, kind: str, name: str) -> list[str]:
    """Returns a command on the tiny scene; each shares with nobody.

    Masks and references are the truth's, and nothing is completed: they pass through the same stages as a network's,
    which take far longer.
    """
    scene = [
        "dataset=zju", f"dataset.root={place}", "dataset.scene=001-clean",
        f"body.path={place}/001-clean/body.npz", "optim.steps=16", "refine.steps=8", "optim.lambda_lpips=0",
        "refine.lambda_lpips=0", "evaluation.perceptual=false", "evaluation.curve_images=1", "evaluation.turntable=0",
        "init.source=truth", "refine.references.source=truth", "registration=off", "optim.align_poses=false",
        "evaluation.pictures=false", "optim.unseen_colors=nearest",
        "trainer.checkpoint_every=5", "trainer.accelerator=cpu", f"shared_dir={place / name / 'shared'}",
    ]  # fmt: skip
    prior = [
        "stage=prior", "prior_training=silhouette", "prior_training.widths=[8,16]", "prior_training.depth=1",
        "prior_training.steps=30", "prior_training.batch=2", "prior_training.examples=16",
        "prior_training.validation=2", "trainer.checkpoint_every=6", "trainer.accelerator=cpu",
    ]  # fmt: skip
    several = ["-m", "variant=gauhuman,B", f"hydra.sweep.dir={place / name / 'sweep'}"]
    if kind == "scene":
        return ["synth", str(place / name), "--size", "64", "--frames", "8", "--cameras", "2"]
    words = {
        "run": [*scene, "variant=E", f"output_dir={place / name / 'run'}"],
        "prior": [*prior, f"output_dir={place / name / 'run'}"],
        "multirun": [*several, *scene, f"output_dir={place / name}/${{variant.name}}"],
    }
    return [str(ROOT / "train.py"), *words[kind]]


def preload() -> None:
    """Imports what commands import, so that processes forked from this one need not: most stops then fall into work."""
    sys.path[:0] = [str(ROOT / "src")]
    from occfusion.cpu.loading import loading

    with loading():  # nor do they search it for garbage
        import occfusion.cli.synth
        import occfusion.cli.train
        import occfusion.run.app  # noqa: F401


def run_until(
    arguments: Sequence[str], output: Path, number: signal.Signals, after: float | None
) -> tuple[int, bool, str]:
    """Runs in a forked process and sends it a signal; returns exit code, whether it was sent, and output.

    Args:
        arguments: of the command.
        output: file for what it says.
        number: of the signal.
        after: seconds of the processor, so that others on the machine change nothing; None: it is not stopped.
    """
    output.parent.mkdir(parents=True, exist_ok=True)
    child = os.fork()
    if child == 0:
        code = 1
        try:
            stream = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(stream, 1)
            os.dup2(stream, 2)
            signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
            from occfusion.__main__ import main as verb
            from occfusion.cli.train import find_config_dir
            from occfusion.cli.train import main as train

            sys.argv = list(arguments)
            try:
                code = verb(list(arguments)) if arguments[0] == "synth" else train(find_config_dir())
            except KeyboardInterrupt:  # as train.py does
                code = 130
            except BaseException:  # as Python would show it
                traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    ended, status, is_sent = 0, 0, False
    while not ended:
        time.sleep(0.01)
        if after is not None and not is_sent and busy_seconds(child) > after:
            os.kill(child, number)
            is_sent = True
        ended, status = os.waitpid(child, os.WNOHANG)
    return os.waitstatus_to_exitcode(status), is_sent, output.read_text(errors="replace")


def busy_seconds(process: int) -> float:
    """Returns the processor time of a process so far."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def made(folder: Path) -> dict[str, object]:
    """Returns all that must be the same however often a command was stopped."""
    found: dict[str, object] = {}
    for path in sorted({path for pattern in KEPT for path in folder.rglob(pattern)}):
        name = path.relative_to(folder).as_posix()
        if name.startswith("shared/") or not path.is_file():
            continue
        if path.suffix == ".safetensors":  # its header has the seconds that it took
            found[name] = {
                key: (value.shape, value.numpy().tobytes()) for key, value in load_file(path).items()
            }
        else:
            found[name] = path.read_bytes()
    return found


def moment(folder: Path, kind: str) -> str:
    """Returns what a stopped command was at, by what is there of its first run that is not finished."""
    if kind == "scene":
        return "scene"
    if kind == "prior":
        run = folder / "run"
        return "prior" if (run / "losses.csv").exists() else "corpus"
    runs = [folder / "run"] if kind == "run" else [folder / "gauhuman", folder / "B"]
    run = next((run for run in runs if not (run / "finished.json").exists()), None)
    if run is None:
        return "end"
    if not (run / "plan.json").exists():
        return "reading"
    stages = {"gauhuman": ["optim"], "B": ["init", "optim"]}.get(run.name, ["init", "optim", "refine"])
    return next((stage for stage in stages if not (run / stage / "stage.json").exists()), "evaluation")


def prepare(place: Path, kinds: Sequence[str], *, twice: bool = True) -> dict[str, float]:
    """Writes the scene and uninterrupted results of each kind where they are missing; returns their CPU seconds.

    With `twice` a second result of each kind must equal the first.
    """
    if not (place / "001-clean").is_dir():
        written = [
            sys.executable, "-m", "occfusion", "synth", str(place), "--size", "64", "--frames", "4", "--cameras", "2",
        ]  # fmt: skip
        subprocess.run(
            written,
            check=True,
            env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
            stdout=subprocess.DEVNULL,
        )
    times = {}
    for kind in kinds:
        clock = place / f"{kind}.seconds"
        if not clock.is_file():
            names = (f"{kind}-whole", f"{kind}-again") if twice else (f"{kind}-whole",)
            for name in names:  # the first compiles what the second finds
                shutil.rmtree(place / name, ignore_errors=True)
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                code, _, said = run_until(
                    command(place, kind, name), place / f"{name}.txt", signal.SIGKILL, None
                )
                if code != 0:
                    raise SystemExit(said)
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            whole = made(place / f"{kind}-whole")
            if not whole or whole != made(place / names[-1]):
                raise SystemExit(
                    f"two commands ({kind}) that nobody stopped differ: no stop can be judged by them"
                )
            clock.write_text(f"{seconds:.2f}\n")
        times[kind] = float(clock.read_text())
    return times


def stop_again_and_again(place: Path, kind: str, number: int, stops: int, seconds: float) -> dict[str, str]:
    """Stops a command up to so many times, lets it end, compares; returns its row."""
    name = f"{kind}-{number}"
    folder, output, words = place / name, place / f"{name}.txt", command(place, kind, name)
    shutil.rmtree(folder, ignore_errors=True)  # where this script was stopped itself
    chance, signals, moments, faults = random.Random(f"{kind} {number}"), [], [], []
    while len(signals) < stops:
        sent = chance.choice(SIGNALS)
        code, is_sent, said = run_until(words, output, sent, chance.uniform(0.0, SPAN * seconds))
        if is_sent:
            signals.append(sent.name)
            moments.append(moment(folder, kind))
            if code not in CLEAN[sent] | {0}:
                faults.append(f"{sent.name} ended with {code}: {said[-400:]}")
        if "Traceback" in said:
            begins = max(said.index("Traceback") - 400, 0)
            faults.append(f"traceback after {sent.name}, exit code {code}: {said[begins : begins + 4000]}")
        if code == 0:
            break
    code, _, said = run_until(words, output, signal.SIGKILL, None)
    if code:
        faults.append(f"the last one ended with {code}: {said[-400:]}")
    expected, found = made(place / f"{kind}-whole"), made(folder)
    others = [
        part for part in sorted(expected.keys() | found.keys()) if expected.get(part) != found.get(part)
    ]
    faults += [
        f"{part} is another one: {_difference(expected.get(part), found.get(part))}" for part in others
    ]
    if not faults:
        shutil.rmtree(folder, ignore_errors=True)
    return {
        "kind": kind, "number": str(number), "stops": str(len(signals)), "signals": " ".join(signals),
        "moments": " ".join(moments), "faults": "; ".join(faults),
    }  # fmt: skip


def _difference(expected: object, found: object) -> str:
    """Returns where two contents part: the first differing line of a table, names of differing tensors."""
    if expected is None or found is None:
        return "it is missing here" if found is None else "nobody who was not stopped has it"
    if isinstance(expected, dict) and isinstance(found, dict):
        return ", ".join(
            key for key in sorted(expected.keys() | found.keys()) if expected.get(key) != found.get(key)
        )
    assert isinstance(expected, bytes) and isinstance(found, bytes)
    lines = zip(expected.splitlines(), found.splitlines(), strict=False)
    number, pair = next(((k, pair) for k, pair in enumerate(lines, 1) if pair[0] != pair[1]), (0, (b"", b"")))
    if not number:
        return f"{len(found)} bytes for {len(expected)}, equal as far as both go"
    return f"line {number}: {pair[1][:400]!r} for {pair[0][:400]!r}"


def main() -> int:
    """Stops and compares; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--stops", type=int, default=200, help="in all, with those that the place has (%(default)s)"
    )
    parser.add_argument("--each", type=int, default=12, help="stops of one command at most")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), help="of commands, in turn")
    parser.add_argument(
        "--once", action="store_true", help="trust that two commands make the same: compare with one"
    )
    parser.add_argument("--place", type=Path, default=Path("runs/stops"), help="goes on with what it has")
    args = parser.parse_args()
    place = args.place.absolute()
    place.mkdir(parents=True, exist_ok=True)
    preload()
    seconds, table = prepare(place, args.kinds, twice=not args.once), place / "stops.csv"
    rows = list(csv.DictReader(table.open())) if table.is_file() else []
    while (left := args.stops - sum(int(row["stops"]) for row in rows)) > 0:
        kind = min(args.kinds, key=lambda kind: sum(row["kind"] == kind for row in rows))
        number = sum(row["kind"] == kind for row in rows)
        rows.append(stop_again_and_again(place, kind, number, min(args.each, left), seconds[kind]))
        with table.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
        print(f"{kind}: {rows[-1]['moments']}", flush=True)
        print(_summary(rows), flush=True)
    print("\n".join(row["faults"] for row in rows if row["faults"]))
    return int(any(row["faults"] for row in rows))


def _summary(rows: Sequence[dict[str, str]]) -> str:
    signals = Counter(word for row in rows for word in row["signals"].split())
    moments = Counter(word for row in rows for word in row["moments"].split())
    bad = sum(bool(row["faults"]) for row in rows)
    parts = [
        ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
        for counts in (signals, moments)
    ]
    return f"{sum(signals.values())} stops ({'; '.join(parts)}) of {len(rows)} commands, {bad} with faults"


if __name__ == "__main__":
    sys.exit(main())
