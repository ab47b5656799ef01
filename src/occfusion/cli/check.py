"""`python -m occfusion check DATA`: what is in a data folder, what is wrong with it, and what to do."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from occfusion.data.checking.fit import (
    draw_overlay,
    inspect_coverage,
    inspect_fit,
    inspect_other_cameras,
    inspect_registration,
)
from occfusion.data.checking.inspection import (
    Finding,
    Inspection,
    guarded,
    inspect_bodies,
    inspect_cameras,
    inspect_files,
    inspect_masks,
    worst,
)
from occfusion.data.layouts import AUTO, LAYOUTS, sequences_in
from occfusion.data.opening import open_folder
from occfusion.data.posing import Poser
from occfusion.data.scene import Scene
from occfusion.data.zju.stored_vertices import compare_with_stored
from occfusion.data.zju.zju_layout import ZjuScene
from occfusion.errors import ConfigError, OccfusionError
from occfusion.files.atomic import write_png
from occfusion.human import Body, embedded_body, load_body
from occfusion.human.coverage_picture import draw_coverage

COLOURS = {"error": "red", "doubt": "yellow", "note": "cyan", "ok": "green"}
GRAVITY = tuple(COLOURS)
PARTS = (
    inspect_files,
    inspect_cameras,
    inspect_bodies,
    inspect_masks,
    inspect_fit,
    inspect_registration,
    inspect_other_cameras,
    inspect_coverage,
)
EXIT_DOUBT = 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument("data", type=Path, metavar="DATA", help="a sequence's folder, or a folder of them")
    parser.add_argument("--scene", help="the sequence, where one file holds several (OcMotion as released)")
    parser.add_argument(
        "--body", type=Path, help="the SMPL file (default: DATA/body.npz, else the embedded body, roughly)"
    )
    parser.add_argument(
        "--layout", default=AUTO, choices=(AUTO, *(layout.name for layout in LAYOUTS)),
        help="how to read a folder that could be read in several ways (default: look)",
    )  # fmt: skip
    parser.add_argument("--camera", type=int, default=0, help="index of the training camera (default: 0)")
    parser.add_argument("--masks", help="mask folder (default: the layout's)")
    parser.add_argument("--person", type=int, help="which of several people, where the files tell them apart")
    parser.add_argument(
        "--numbered-masks", action="store_true", help="masks hold the people's ids (OcMotion as released)"
    )
    parser.add_argument(
        "--overlay", type=Path, help="where the overlay picture goes (default: check_SCENE.png here)"
    )
    parser.add_argument(
        "--strict", action="store_true", help=f"exit with {EXIT_DOUBT} when something is doubtful"
    )


def run(arguments: argparse.Namespace) -> int:
    """Checks one sequence or all of a folder; returns 0, 1 after an error, with --strict 2 after a doubt."""
    folders = _folders(arguments.data)
    if arguments.overlay is not None and len(folders) > 1:
        raise ConfigError("--overlay names one file; check the sequences one by one, or leave it out.")
    levels = [_check(folder, arguments) for folder in folders]
    if "error" in levels:
        return 1
    return EXIT_DOUBT if arguments.strict and "doubt" in levels else 0


def _folders(data: Path) -> list[Path]:
    if any(layout.fits(data) for layout in LAYOUTS):
        return [data]
    return sequences_in(data) or [data]


def _check(folder: Path, arguments: argparse.Namespace) -> str:
    findings, inspection = _inspect(folder, arguments)
    table = Table(title=escape(str(folder)), title_justify="left", show_lines=True)
    for heading in ("", "what", "found", "what to do"):
        table.add_column(heading, overflow="fold")
    for finding in findings:
        mark = Text(finding.level, style=COLOURS[finding.level])
        table.add_row(mark, *(Text(part) for part in (finding.topic, finding.text, finding.cure)))
    Console().print(table)
    if inspection is not None:
        _draw(inspection, arguments.overlay or Path(f"check_{inspection.scene.name}.png"))
    level = worst(findings)
    verdict = {
        "error": "training would not start",
        "doubt": "training would start; look at the doubts first",
    }.get(level, "ready to train")
    print(f"{folder}: {verdict}")
    return level


def _draw(inspection: Inspection, path: Path) -> None:
    """Writes what there is to draw of a sequence: the overlay, and beside it from where its body is seen."""
    picture = draw_overlay(inspection)
    if picture is not None:
        write_png(path, picture)
        print(f"overlay (mask green, body red, joints yellow): {path}")
    if inspection.coverage is not None and isinstance(inspection.poser.body, Body):
        path = path.with_name(f"{path.stem}_directions.png")
        write_png(path, draw_coverage(inspection.poser.body, inspection.coverage))
        print(f"directions (green: seen from many, yellow: from one, red: not at all): {path}")


def _inspect(folder: Path, arguments: argparse.Namespace) -> tuple[list[Finding], Inspection | None]:
    findings: list[Finding] = []
    try:
        poser, body = _poser(folder, arguments.body)
        findings.append(body)
        layout, scene = open_folder(
            folder, poser, arguments.masks, arguments.scene, arguments.person,
            numbered=arguments.numbered_masks, layout=arguments.layout,
        )  # fmt: skip
    except OccfusionError as error:
        return [*findings, Finding("error", "folder", str(error))], None
    text = f"{layout}: {scene.num_frames} frames, {len(scene.cameras)} cameras"
    findings.append(Finding("ok", "layout", text))
    findings += guarded("body file", lambda: _against_vertices(scene, poser))
    findings += [Finding("note", "taken", line) for line in scene.taken.lines()]
    findings += [Finding("doubt", "layout", remark) for remark in scene.remarks]
    if not 0 <= arguments.camera < len(scene.cameras):
        raise ConfigError(
            f"--camera {arguments.camera}: the scene has the cameras 0..{len(scene.cameras) - 1}."
        )
    inspection = Inspection(scene, poser, arguments.camera)
    for part in PARTS:
        findings += part(inspection)
    # the gravest first; otherwise in the order in which they were made
    return sorted(findings, key=lambda finding: GRAVITY.index(finding.level)), inspection


def _poser(folder: Path, path: Path | None) -> tuple[Poser, Finding]:
    own = folder / "body.npz"
    if path is None and not own.is_file():
        return Poser(embedded_body(), stands_in=True), Finding(
            "note", "body file", "none given: the embedded body stands in, so height and fit are rough",
            "name the one that the parameters were fitted with: --body SMPL_NEUTRAL.pkl",
        )  # fmt: skip
    return Poser(load_body(path or own)), Finding("ok", "body file", str(path or own))


def _against_vertices(scene: Scene, poser: Poser) -> list[Finding]:
    """Notes in what was taken how the body fits the vertices beside the parameters, where there are any."""
    if isinstance(scene, ZjuScene) and not poser.stands_in:
        compare_with_stored(scene, poser.body)
    return []
