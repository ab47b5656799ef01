"""Studies on held-out synthetic people: a row a run in a CSV, and the table of the page made from it.

python scripts/measure_studies.py ablation WORK           # runs what docs/results/ablation.csv lacks
python scripts/measure_studies.py turning WORK --page     # and nothing more than the page from it

Rows that stand are kept, so it may be stopped at any time and goes on where it was. Masks and optimisations that
runs of a study have in common are computed once, in WORK/shared; seconds are of the stages that a row ran itself.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean

from disturb_scene import disturb, replace_object

from occfusion.files.table import read_table, write_table
from occfusion.synth.scene import Scene
from occfusion.synth.spec import SceneSpec
from occfusion.synth.writer import body_content, camera_annotations

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs/results"
BEGUN, ENDED = "<!-- measured -->", "<!-- /measured -->"
OF_FRAMES = ("psnr", "ssim", "lpips", "mask_iou", "spill")
FIGURES = (*OF_FRAMES, "unseen_psnr", "unseen_lpips", "hidden_psnr", "hidden_lpips")
Row = dict[str, object]


@dataclass(frozen=True)
class Case:
    """One run.

    Attributes:
        names: values of the study's keys.
        overrides: what makes the run.
        errors: of `disturb_scene`, put into its input.
        true_bodies: whether bodies and cameras are the true ones and not an estimator's.
    """

    names: tuple[str, ...]
    overrides: tuple[str, ...]
    errors: Mapping[str, float] = field(default_factory=dict)
    true_bodies: bool = False


@dataclass(frozen=True)
class Study:
    """What is run and how it is told.

    Attributes:
        about: the page's text above the table.
        size: of the pictures, pixels.
        keys: columns that name a row; `scene` is the first.
        cases: yields its runs.
        group: from a row, what stands in the first columns of the page; rows of one group are averaged.
        heads: titles of those columns.
        cells: titles and formats of figures; several figures in one cell.
    """

    about: str
    size: int
    keys: tuple[str, ...]
    cases: Callable[[], Iterator[Case]]
    group: Callable[[dict[str, str]], tuple[str, ...]]
    heads: tuple[str, ...]
    cells: dict[str, str]


def level(row: dict[str, str]) -> str:
    return row["scene"].split("-")[1]


def variants() -> Iterator[Case]:
    names = ("gauhuman", "A", "B", "C", "D", "E")
    for recipe, subject, poses, name in itertools.product(
        ("ours", "paper"), (103, 104, 105), ("clean", "hard"), names
    ):
        yield Case((f"{subject}-{poses}", recipe, name), (f"recipe={recipe}", f"variant={name}"))


def turning() -> Iterator[Case]:
    for subject, poses, turn in itertools.product(range(103, 109), ("clean", "hard"), ("", "-front")):
        yield Case((f"{subject}-{poses}{turn}",), ("variant=E",))


def trial() -> Iterator[Case]:
    """Of the paper's priors on people who do not turn: distillation and inpainting, on and off, nothing left out."""
    for subject, poses, name in itertools.product((103, 104, 105), ("clean", "hard"), ("B", "C", "D", "E")):
        yield Case((f"{subject}-{poses}-front", name), (f"variant={name}", "plan=full"))


AMOUNTS = {
    "none": (0.0,),
    "pose": (0.02, 0.05, 0.1),
    "place": (0.01, 0.02, 0.05),
    "shape": (0.5, 1.0),
    "focal": (0.01, 0.03),
    "shift": (0.5, 1.0, 2.0),
    "mask": (0.5, 1.0, 2.0),
    "light": (0.05, 0.1, 0.2),
    "blur": (0.5, 1.0, 2.0),
    "noise": (4.0, 8.0, 16.0),
}
TOGETHER = {"pose": 0.05, "place": 0.01, "shift": 0.5, "mask": 0.5, "light": 0.05, "blur": 0.5, "noise": 4.0}
HIDDEN_SHARES = (0.0, 0.25, 0.75, 0.9)
FRAME_STEPS = (2, 4, 10)


def inputs() -> Iterator[Case]:
    """One error of the input at a time, then several together; the training camera's alone but for bodies."""
    for subject in (103, 104, 105):
        scene = f"{subject}-clean"
        for error, amounts in AMOUNTS.items():
            for amount in amounts:
                errors = {error: amount} if amount else {}
                yield Case((scene, error, f"{amount:g}"), ("variant=E",), errors)
        yield Case((scene, "together", "1"), ("variant=E",), TOGETHER)
        for share in HIDDEN_SHARES:
            yield Case(
                (scene, "hidden share", f"{share:g}"), ("variant=E", f"dataset.occlusion.share={share:g}")
            )
        for step in FRAME_STEPS:
            override = f"dataset.train_frames=[0,100,{step}]"
            yield Case((scene, "frames", f"{100 // step}"), ("variant=E", override))


AS_GIVEN = (
    "optim.align_poses=false", "optim.refine_pose=false", "optim.pose_knots=0", "optim.learn_skinning=false",
)  # fmt: skip


def poses() -> Iterator[Case]:
    """With poses as they are given, as they are mended, and true; `clean` and `camera` show what mending costs."""
    for subject, name in itertools.product(range(103, 109), ("hard", "wild")):
        scene = f"{subject}-{name}"
        yield Case((scene, "given"), ("variant=E", *AS_GIVEN))
        yield Case((scene, "mended"), ("variant=E",))
        yield Case((scene, "true"), ("variant=E", *AS_GIVEN), true_bodies=True)
    for subject, name in itertools.product(range(103, 109), ("clean", "camera")):
        yield Case((f"{subject}-{name}", "given"), ("variant=E", *AS_GIVEN))
        yield Case((f"{subject}-{name}", "mended"), ("variant=E",))


FULL = {"PSNR": "{psnr:.2f}", "ST-LPIPS x1000": "{lpips:.1f}", "mask IoU": "{mask_iou:.3f}"}
HIDDEN = {"hidden parts": "{hidden_psnr:.2f} / {hidden_lpips:.1f}"}
UNSEEN = {"in no frame": "{unseen_psnr:.2f} / {unseen_lpips:.1f}"}
SECONDS = {"seconds": "{seconds:.0f}"}
STUDIES = {
    "ablation": Study(
        "# What each stage brings, with both recipes", 128, ("scene", "recipe", "variant"), variants,
        lambda row: (level(row), f"`{row['recipe']}`", f"`{row['variant']}`"),
        ("poses", "recipe", "variant"), FULL | HIDDEN,
    ),
    "turning": Study(
        "# A person who does not turn, beside the same person turning", 256, ("scene",), turning,
        lambda row: (level(row), "faces the camera" if "front" in row["scene"] else "turns"),
        ("poses", "person"), FULL | {"spill, %": "{spill:.1%}"} | UNSEEN | SECONDS,
    ),
    "trial": Study(
        "# The paper's priors on people who do not turn", 128, ("scene", "variant"), trial,
        lambda row: (level(row), f"`{row['variant']}`"),
        ("poses", "variant"), FULL | HIDDEN | UNSEEN | SECONDS,
    ),
    "poses": Study(
        "# Poses as given, mended and true", 128, ("scene", "poses"), poses,
        lambda row: (level(row), row["poses"]), ("level", "poses"), FULL | HIDDEN | SECONDS,
    ),
    "input": Study(
        "# Error against the error of the input", 128, ("scene", "error", "amount"), inputs,
        lambda row: (row["error"], row["amount"]),
        ("error", "amount"), FULL | HIDDEN,
    ),
}  # fmt: skip


def put_true_bodies(folder: Path, name: str, size: int) -> None:
    """Puts the true bodies and cameras in place of an estimator's in a copy of an embedded scene."""
    scene = Scene(replace(SceneSpec.parse(name), image_size=size, cameras=8))
    scene.disk_betas, scene.disk_take, scene.disk_cameras = scene.subject.betas, scene.take, scene.cameras
    (folder / "scene.json").unlink()  # it is not that scene any more
    shutil.rmtree(folder / "new_vertices")
    replace_object(folder / "annots.npy", camera_annotations(scene))
    for frame in range(scene.spec.frames):
        replace_object(folder / "new_params" / f"{frame}.npy", body_content(scene.parameters(frame)))


def scene_folder(work: Path, size: int, case: Case) -> Path:
    """Returns a folder of scenes that holds a case's, with its errors; made once."""
    scene, errors = case.names[0], case.errors
    whole = work / f"scenes-{size}"
    if not (whole / scene).is_dir():
        made = ["synth", str(whole), "--scene", scene, "--size", str(size), "--cameras", "8"]
        subprocess.run([sys.executable, "-m", "occfusion", *made], check=True)
    if case.true_bodies:
        true = work / f"true-{size}"
        if not (true / scene).is_dir():
            partial = true / f"{scene}.partial"
            shutil.copytree(whole / scene, partial, copy_function=os.link)
            put_true_bodies(partial, scene, size)
            partial.rename(true / scene)
        return true
    if not errors:
        return whole
    off = work / f"off-{size}" / "-".join(f"{name}{amount:g}" for name, amount in errors.items())
    if not (off / scene).is_dir():
        disturb(whole / scene, off / f"{scene}.partial", errors)
        (off / f"{scene}.partial").rename(off / scene)
    return off


def measure(work: Path, size: int, case: Case, name: str) -> Row:
    """Returns the figures of a run made for them.

    Raises:
        CalledProcessError: the run failed.
    """
    scene, folder = case.names[0], work / "runs" / name
    data = scene_folder(work, size, case)
    options = (
        "dataset=zju", f"dataset.root={data}", f"dataset.scene={scene}", f"dataset.image_size={size}",
        "body=smpl", f"body.path={data / scene / 'body.npz'}", f"output_dir={folder}", f"shared_dir={work / 'shared'}",
        "trainer.enable_progress_bar=false", "evaluation.perceptual_every=4", "evaluation.pictures=false",
    )  # fmt: skip
    subprocess.run([sys.executable, "train.py", *options, *case.overrides], check=True, cwd=ROOT)
    metrics = json.loads((folder / "metrics.json").read_text())
    full, hidden, unseen = (metrics["regions"][region] for region in ("full", "hidden", "unseen"))
    revision = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True, cwd=ROOT
    ).stdout.strip()
    return {
        **{key: full[key] for key in OF_FRAMES},
        "unseen_psnr": unseen["psnr"], "unseen_lpips": unseen["lpips"],
        "hidden_psnr": hidden["psnr"], "hidden_lpips": hidden["lpips"],
        "seconds": metrics["train_seconds"]["total"], "revision": revision,
    }  # fmt: skip


def page(study: Study, rows: Sequence[dict[str, str]]) -> str:
    """Returns the table: means over subjects, and of how many."""
    groups: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault(study.group(row), []).append(row)
    heads = [*study.heads, *study.cells, "subjects"]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for group, own in groups.items():
        values = {key: [float(row[key]) for row in own if row[key]] for key in (*FIGURES, "seconds")}
        means = {key: fmean(some) if some else float("nan") for key, some in values.items()}
        means |= {key: 1000.0 * mean for key, mean in means.items() if key.endswith("lpips")}
        cells = (cell.format(**means).replace("nan", "-") for cell in study.cells.values())
        lines.append(f"| {' | '.join((*group, *cells, str(len(own))))} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("work", type=Path, help="folder for scenes and runs")
    parser.add_argument(
        "--page", action="store_true", help="write the page of the rows that stand; run nothing"
    )
    arguments = parser.parse_args()
    study, table = STUDIES[arguments.study], RESULTS / f"{arguments.study}.csv"
    rows: list[Row] = [dict(row) for row in read_table(table)]
    if not arguments.page:
        done = {tuple(row[key] for key in study.keys) for row in rows}
        for case in study.cases():
            if case.names not in done:
                name = "-".join((arguments.study, *case.names)).replace(" ", "_")
                figures = measure(arguments.work.resolve(), study.size, case, name)
                rows.append({**dict(zip(study.keys, case.names, strict=True)), **figures})
                write_table(table, (*study.keys, *FIGURES, "seconds", "revision"), rows)
    file = RESULTS / f"{arguments.study}.md"
    text = file.read_text() if file.is_file() else f"{study.about}\n\n{BEGUN}\n{ENDED}\n"
    before, _, rest = text.partition(BEGUN)
    _, _, after = rest.partition(ENDED)
    file.write_text(f"{before}{BEGUN}\n{page(study, read_table(table))}\n{ENDED}{after}")


if __name__ == "__main__":
    main()
