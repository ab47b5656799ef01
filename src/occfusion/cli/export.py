"""`python -m occfusion export RUN --output FILE`: a trained avatar for other programs; the suffix says the format."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import track

from occfusion.errors import ConfigError
from occfusion.export.splats import canonical_table, posed_table, viewers_widening, write_splat_glb
from occfusion.export.web import write_page
from occfusion.files.atomic import folder_beside, numbered, put_in_place
from occfusion.files.packed_splats import COMPRESSED_SUFFIX, write_compressed_ply, write_spz
from occfusion.files.ply import SplatTable, write_ply
from occfusion.human.rendering import Renderer
from occfusion.motion import EMBEDDED_CLIPS, Performance, perform
from occfusion.run.loaded import LoadedRun, load_run
from occfusion.run.showing import SEQUENCE, MotionChoice, find_performance
from occfusion.show.drawing import ESTIMATED, footprint, parse_light
from occfusion.show.views import TRAIN

WRITERS: dict[str, Callable[[Path, SplatTable], None]] = {
    ".ply": write_ply,
    COMPRESSED_SUFFIX: write_compressed_ply,
    ".spz": write_spz,
    ".glb": write_splat_glb,
}
"""Files of Gaussians by the ends of their names; the longest that fits counts."""
PAGE, MESH = ".html", ".obj"
PAGE_CLIPS = ("walk", "squat")
"""Embedded clips of a page, beside the motion that is asked for."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument("run", type=Path, help="a run folder")
    parser.add_argument(
        "--output", type=Path, required=True,
        help=".ply: Gaussians in the layout of 3DGS; .compressed.ply: in that of SuperSplat; .spz (version 3); .glb: "
        "glTF's; a folder: a .ply a frame; .obj: a mesh with colours; .html: a page that plays the avatar",
    )  # fmt: skip
    parser.add_argument(
        "--pose", type=int, help="frame of the motion, for Gaussians and .obj. Default: the canonical pose"
    )
    parser.add_argument(
        "--motion",
        help=f"sequence, {', '.join(EMBEDDED_CLIPS)}, another run, or a file. Default: sequence",
    )  # fmt: skip
    parser.add_argument("--motion-fps", type=float, help="frames a second of a motion that does not say")
    parser.add_argument("--fps", type=float, help="frames a second that the motion is resampled to")
    parser.add_argument(
        "--light", help="of posed Gaussians: even, estimated, or AZIMUTH,HEIGHT. Default: estimated"
    )
    parser.add_argument(
        "--surface", action="store_true",
        help="a .glb of the surface instead of Gaussians: a mesh with colours and a skeleton that plays the motion",
    )  # fmt: skip
    parser.add_argument(
        "--for-viewers", type=int, metavar="PIXELS",
        help="bake the footprint in, so that a viewer that adds 0.3 square pixels shows pictures of so many as we do",
    )  # fmt: skip
    parser.add_argument(
        "--stage", choices=("optim", "refine"), help="the avatar of that stage. Default: the last"
    )


def run(arguments: argparse.Namespace) -> int:
    """Writes; returns the exit code."""
    output, suffix = arguments.output, arguments.output.suffix.lower()
    if suffix and suffix not in (*WRITERS, MESH, PAGE):
        raise ConfigError(
            f"--output {output}: formats are {', '.join((*WRITERS, MESH, PAGE))}, or a folder for a .ply a frame"
        )
    if not suffix and output.exists() and not output.is_dir():
        raise ConfigError(f"--output {output} is a file; name a folder for a .ply a frame")
    _check_used(arguments)
    loaded = load_run(arguments.run, arguments.stage)
    if loaded.remark:
        print(loaded.remark, file=sys.stderr)
    motion = MotionChoice(arguments.motion or SEQUENCE, arguments.motion_fps, arguments.fps)
    if suffix == PAGE:
        _page(loaded, motion, output)
    elif suffix == MESH or arguments.surface:
        _mesh(loaded, motion, arguments)
    else:
        _splats(loaded, motion, arguments)
    return 0


def _check_used(arguments: argparse.Namespace) -> None:
    """Refuses rates that are none, and options that the format would leave without effect."""
    for name in ("fps", "motion_fps"):
        rate = getattr(arguments, name)
        if rate is not None and not 0 < rate <= 100_000:
            raise ConfigError(f"--{name.replace('_', '-')} {rate:g}: must be positive")
    output, suffix = arguments.output, arguments.output.suffix.lower()
    is_splats = (suffix in WRITERS or not suffix) and not arguments.surface
    is_posed = arguments.pose is not None or not suffix
    if arguments.pose is not None and (suffix == PAGE or not suffix):
        raise ConfigError(f"--pose {arguments.pose}: {output} has all frames of the motion; leave it out")
    if arguments.light is not None and not is_splats:
        raise ConfigError(f"--light {arguments.light}: {output} is in even light; leave it out")
    if arguments.for_viewers is not None and not is_splats:
        raise ConfigError(f"--for-viewers is for files of Gaussians; {output} is none")
    if arguments.surface and suffix == PAGE:
        raise ConfigError(f"--surface: {output} plays Gaussians; leave it out, or name a .glb")
    moves = suffix == PAGE or (suffix == ".glb" and arguments.surface)
    asked = {
        "--motion": arguments.motion,
        "--motion-fps": arguments.motion_fps,
        "--fps": arguments.fps,
        "--light": arguments.light,
    }
    unused = [name for name, value in asked.items() if value is not None]
    if unused and not is_posed and not moves:
        raise ConfigError(
            f"{', '.join(unused)}: {output} would be in the canonical pose and even light, which know neither motion "
            "nor lamp; add --pose FRAME, or name a folder for a .ply a frame"
        )


def _page(loaded: LoadedRun, motion: MotionChoice, output: Path) -> None:
    performances = _motions(loaded, motion)
    title = str(loaded.settings.dataset.scene or loaded.folder.path.resolve().name)
    write_page(output, loaded.avatar, performances, title=title, pixel=loaded.pixel)
    _say_motions(output, performances)


def _motions(loaded: LoadedRun, motion: MotionChoice) -> list[Performance]:
    """Returns the motion that is asked for, and those that files with several have beside it."""
    words = [motion.words, *(name for name in PAGE_CLIPS if name != motion.words)]
    return [
        find_performance(loaded, MotionChoice(word, motion.own_fps if k == 0 else None, motion.fps))
        for k, word in enumerate(words)
    ]


def _say_motions(output: Path, performances: Sequence[Performance]) -> None:
    names = ", ".join(each.clip.name for each in performances)
    print(f"{output}: {output.stat().st_size / 1e6:.1f} MB, even light, motions {names}")


def _mesh(loaded: LoadedRun, motion: MotionChoice, arguments: argparse.Namespace) -> None:
    from occfusion.export.mesh import write_obj, write_skinned_glb
    from occfusion.export.surface import find_surface

    output: Path = arguments.output
    has_pose, is_obj = arguments.pose is not None, output.suffix.lower() == MESH
    if not is_obj and (output.suffix.lower() != ".glb" or has_pose):
        raise ConfigError(
            "--surface is for a .glb without --pose, which has the whole motion; or name an .obj"
        )
    performance = find_performance(loaded, motion) if has_pose else None
    if performance is not None:
        _check_pose(arguments.pose, performance)
    surface = find_surface(loaded.avatar, loaded.betas, Renderer("auto"))
    if is_obj:
        vertices = surface.rest
        if performance is not None:
            vertices = surface.posed(loaded.avatar, performance, arguments.pose)
        write_obj(output, vertices, surface)
        print(
            f"{output}: {len(vertices)} vertices, {'posed' if has_pose else 'at rest'}, colours of even light"
        )
        return
    performances = _motions(loaded, motion)
    write_skinned_glb(output, loaded.avatar, surface, performances)
    _say_motions(output, performances)


def _check_pose(row: int, performance: Performance) -> None:
    if not 0 <= row < len(performance):
        raise ConfigError(f"--pose {row}: the motion has the frames 0 to {len(performance) - 1}")


def _splats(loaded: LoadedRun, motion: MotionChoice, arguments: argparse.Namespace) -> None:
    avatar, widen = loaded.avatar, 0.0
    if arguments.for_viewers is not None:
        if not 8 <= arguments.for_viewers <= 8192:
            raise ConfigError(f"--for-viewers {arguments.for_viewers}: 8 to 8192 pixels")
        scale = arguments.for_viewers / max(loaded.views(TRAIN)[0].camera.width, 1)
        widen = viewers_widening(footprint(avatar.dilation, scale), loaded.pixel / scale)
    output: Path = arguments.output
    ends = [end for end in WRITERS if output.name.lower().endswith(end)]
    write = WRITERS[max(ends, key=len)] if ends else write_ply
    if output.suffix and arguments.pose is None:
        said = "canonical pose, even light"
        write(output, replace(canonical_table(avatar, widen), about=said))
        print(f"{output}: {said}")
        return
    performance = find_performance(loaded, motion)
    own = perform(loaded.clip, avatar.body, loaded.betas)
    light = parse_light(arguments.light or ESTIMATED, avatar, own.upright)
    avatar.relight(None if light.vector is None else performance.upright[:3, :3].T @ light.vector)

    def posed(row: int) -> SplatTable:
        table = posed_table(avatar, performance.pose(row), performance.upright, widen)
        said = f"frame {row} of {performance.clip.name}, {light.text} baked in"
        return replace(table, about=" ".join(said.encode("ascii", "replace").decode().split()))

    count = 1
    with torch.no_grad():
        if output.suffix:
            _check_pose(arguments.pose, performance)
            write(output, posed(arguments.pose))
        else:
            count = len(performance)
            with folder_beside(output) as folder:
                for row in track(range(count), "poses", console=Console(stderr=True)):
                    write(folder / numbered(row, ".ply"), posed(row))
                put_in_place(folder, output, ".ply", count)
    print(f"{output}: {count} of {len(performance)} poses, {light.text} baked in")
