"""Damages every file of a finished run in turn, and looks what the same command and the verbs make of it.

`python scripts/damage_run_folder.py --place runs/damage`: each file is cut short, filled with garbage, replaced by the
same file of another run, and changed by one byte. Then the folder is loaded as `render` and `export` do, a report is
written, and the command is repeated. Right is: a named error, or the very result of before; a traceback or another
result is a fault. A table that only training could make again may be put aside, where that is said. Of folders with a
picture a frame the first is taken. Rows are kept in `damage.csv`; the same command goes on with them. Exits with 1
where there is a fault.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import shutil
import sys
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "src")]

import torch  # noqa: E402
from hydra import compose, initialize_config_dir  # noqa: E402
from safetensors.torch import load_file  # noqa: E402

from occfusion.errors import OccfusionError  # noqa: E402
from occfusion.files.run_folder import RunFolder  # noqa: E402
from occfusion.files.table import read_table  # noqa: E402
from occfusion.report.page import write_report  # noqa: E402
from occfusion.run import app  # noqa: E402
from occfusion.run.loaded import load_run  # noqa: E402
from occfusion.synth import SceneSpec, write_scene  # noqa: E402

OF_THE_CLOCK = ("seconds", "memory")
"""Parts of names of columns and figures that no two runs have alike."""

PUT_ASIDE = "is missing, or not as the run left it; only training could make it again"


def run(place: Path, name: str, seed: int = 0) -> Path:
    """Runs or repeats a small run."""
    scene = place / "001-clean"
    overrides = [
        "dataset=zju", f"dataset.root={place}", "dataset.scene=001-clean", f"body.path={scene}/body.npz", "variant=E",
        "optim.steps=4", "refine.steps=3", "trainer.checkpoint_every=2", "optim.lambda_lpips=0",
        "refine.lambda_lpips=0",
        "evaluation.perceptual=false", "trainer.enable_progress_bar=false", "trainer.accelerator=cpu",
        "evaluation.turntable=2", "evaluation.curve_images=1", "evaluation.training_stride=3", "init.source=truth",
        "refine.references.source=truth", "optim.gaussians=0", f"seed={seed}", f"output_dir={place / name / 'run'}",
        f"shared_dir={place / name / 'shared'}",
    ]  # fmt: skip
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        app.run(compose("config", overrides), folder_chosen_by_user=True)
    return place / name / "run"


def results(folder: Path) -> dict[str, Any]:
    """Returns what must not change: tensors, figures of images, pictures of masks and references, the mean figures."""
    found: dict[str, Any] = {}
    for stage in ("optim", "refine"):
        found[stage] = load_file(folder / stage / "avatar.safetensors")
    for name in ("masks", "inpainted"):
        pictures = sorted((folder / name).rglob("*.png"))
        found[name] = {path.relative_to(folder).as_posix(): path.read_bytes() for path in pictures}
    for name in ("per_image.csv", "losses.csv", "error_vs_time.csv"):
        rows = [
            {key: value for key, value in row.items() if not any(word in key for word in OF_THE_CLOCK)}
            for row in read_table(folder / name)
        ]
        if name == "error_vs_time.csv":  # the clock says when it is measured, but for the end of a stage
            rows = list({row["stage"]: row for row in rows}.values())
        found[name] = rows
    found["point_cloud.ply"] = (folder / "point_cloud.ply").read_bytes()
    found["metrics.json"] = RunFolder(folder).read_metrics()["regions"]
    return found


def differences(found: dict[str, Any], wanted: dict[str, Any]) -> list[str]:
    """Returns the names of what is another one."""
    return [name for name, value in wanted.items() if not _same(found[name], value)]


def _same(one: Any, other: Any) -> bool:
    if isinstance(other, dict) and other and isinstance(next(iter(other.values())), torch.Tensor):
        return one.keys() == other.keys() and all(
            torch.equal(one[key], value) for key, value in other.items()
        )
    return bool(one == other)


def damages(path: Path, other: Path) -> Iterator[tuple[str, bytes]]:
    """Yields damaged contents of a file by their names."""
    whole = path.read_bytes()
    yield "cut short", whole[: len(whole) // 2]
    yield "garbage", bytes((17 * k) % 251 for k in range(200))
    if other.is_file() and other.read_bytes() != whole:
        yield "another run's", other.read_bytes()
    if whole:
        middle = len(whole) // 2
        yield "one byte", whole[:middle] + bytes([whole[middle] ^ 0x15]) + whole[middle + 1 :]


def chosen(folder: Path) -> list[Path]:
    """Returns the files of a run and of what it shares, of a folder of frames the first."""
    taken, frames = [], set()
    for path in sorted(folder.parent.rglob("*")):
        if not path.is_file() or path.suffix == ".lock" or path.name.endswith("lock"):
            continue
        if path.suffix == ".png" and path.stem.isdigit():
            if path.parent in frames:
                continue
            frames.add(path.parent)
        taken.append(path)
    return taken


def attempt(what: Callable[[], object]) -> tuple[str, str]:
    """Returns `fine`, the named error, or the traceback; and what was said meanwhile."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            what()
        except OccfusionError as error:
            return f"{type(error).__name__}: {error}", said.getvalue()
        except BaseException:
            return traceback.format_exc(), said.getvalue()
    return "fine", said.getvalue()


def main() -> int:
    """Damages and looks; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--place", type=Path, default=Path("runs/damage"))
    parser.add_argument("--only", default="", help="files with this in their name")
    args = parser.parse_args()
    place = args.place.absolute()
    if not (place / "other" / "run" / "finished.json").exists():
        shutil.rmtree(place, ignore_errors=True)
        spec = SceneSpec.parse("001-clean")
        write_scene(
            place, type(spec)(**{**vars(spec), "image_size": 64, "frames": 5, "cameras": 2}), progress=False
        )
        run(place, "whole")
        run(place, "other", seed=1)
    whole, other = place / "whole" / "run", place / "other" / "run"
    wanted = results(whole)
    table = place / "damage.csv"
    rows = list(csv.DictReader(table.open())) if table.is_file() else []
    done = {(row["file"], row["damage"]) for row in rows}
    for path in chosen(whole):
        name = path.relative_to(place / "whole").as_posix()
        if args.only not in name:
            continue
        for damage, content in damages(path, place / "other" / name):
            if (name, damage) in done:
                continue
            shutil.rmtree(place / "tried", ignore_errors=True)
            shutil.copytree(place / "whole", place / "tried")
            tried = place / "tried" / "run"
            (place / "tried" / name).write_bytes(content)
            loaded, _ = attempt(partial(load_run, tried))
            reported, _ = attempt(partial(write_report, RunFolder(tried)))
            repeated, told = attempt(partial(run, place, "tried"))
            fault = next((end for end in (loaded, reported, repeated) if "Traceback" in end), "")
            if not fault and repeated == "fine":
                wrong = differences(results(tried), wanted)
                # what only training could make is put aside, and that is said
                wrong = [part for part in wrong if f"{tried / part} {PUT_ASIDE}" not in told]
                fault = f"another result: {', '.join(wrong)}" if wrong else ""
            rows.append(
                {"file": name, "damage": damage, "loaded": loaded, "reported": reported, "repeated": repeated,
                 "fault": fault}
            )  # fmt: skip
            with table.open("w", newline="") as file:
                writer = csv.DictWriter(file, list(rows[0]))
                writer.writeheader()
                writer.writerows(rows)
            print(f"{name}, {damage}: {fault or repeated[:90]}", flush=True)
    bad = [row for row in rows if row["fault"]]
    print(f"{len(rows)} damages, {len(bad)} faults; other is {other}")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
