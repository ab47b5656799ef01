"""`python -m occfusion export RUN --output FILE`: a trained avatar for other programs; the suffix says the format."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from occfusion.errors import ConfigError
from occfusion.export.splats import canonical_table, posed_table, viewers_widening
from occfusion.export.web import write_page
from occfusion.files.ply import write_ply
from occfusion.motion import EMBEDDED_CLIPS, perform
from occfusion.run.loaded import LoadedRun, load_run
from occfusion.run.showing import SEQUENCE, MotionChoice, find_performance
from occfusion.show.drawing import footprint, parse_light
from occfusion.show.views import TRAIN

SUFFIXES = (".ply", ".html")
PAGE_CLIPS = ("walk", "squat")
"""Embedded clips of a page, beside the motion that is asked for."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument("run", type=Path, help="a run folder")
    parser.add_argument(
        "--output", type=Path, required=True,
        help=".ply: Gaussians in the layout of 3DGS; a folder: one a frame; .html: a page that plays the avatar",
    )  # fmt: skip
    parser.add_argument("--pose", type=int, help="frame of the motion, for .ply. Default: the canonical pose")
    parser.add_argument(
        "--motion", default=SEQUENCE,
        help=f"sequence, {', '.join(EMBEDDED_CLIPS)}, another run, or a file. Default: sequence",
    )  # fmt: skip
    parser.add_argument("--motion-fps", type=float, help="frames a second of a motion that does not say")
    parser.add_argument("--fps", type=float, help="frames a second that the motion is resampled to")
    parser.add_argument(
        "--light", default="estimated", help="of a posed .ply: even, estimated, or AZIMUTH,HEIGHT"
    )
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
    if suffix and suffix not in SUFFIXES:
        raise ConfigError(
            f"--output {output}: formats are {', '.join(SUFFIXES)}, or a folder for a .ply a frame"
        )
    if not suffix and output.exists() and not output.is_dir():
        raise ConfigError(f"--output {output} is a file; name a folder for a .ply a frame")
    loaded = load_run(arguments.run, arguments.stage)
    if loaded.remark:
        print(loaded.remark, file=sys.stderr)
    motion = MotionChoice(arguments.motion, arguments.motion_fps, arguments.fps)
    if suffix == ".html":
        _page(loaded, motion, output)
    else:
        _splats(loaded, motion, arguments)
    return 0


def _page(loaded: LoadedRun, motion: MotionChoice, output: Path) -> None:
    words = [motion.words, *(name for name in PAGE_CLIPS if name != motion.words)]
    performances = [
        find_performance(loaded, MotionChoice(word, motion.own_fps if k == 0 else None, motion.fps))
        for k, word in enumerate(words)
    ]
    write_page(output, loaded.avatar, performances, title=loaded.clip.name, pixel=loaded.pixel)
    print(f"{output}: {output.stat().st_size / 1e6:.1f} MB, even light, motions {', '.join(map(str, words))}")


def _splats(loaded: LoadedRun, motion: MotionChoice, arguments: argparse.Namespace) -> None:
    avatar, widen = loaded.avatar, 0.0
    if arguments.for_viewers is not None:
        if not 8 <= arguments.for_viewers <= 8192:
            raise ConfigError(f"--for-viewers {arguments.for_viewers}: 8 to 8192 pixels")
        scale = arguments.for_viewers / max(loaded.views(TRAIN)[0].camera.width, 1)
        widen = viewers_widening(footprint(avatar.dilation, scale), loaded.pixel / scale)
    output: Path = arguments.output
    if output.suffix and arguments.pose is None:
        write_ply(output, canonical_table(avatar, widen))
        print(f"{output}: canonical pose, even light")
        return
    performance = find_performance(loaded, motion)
    own = perform(loaded.clip, avatar.body, loaded.betas)
    light = parse_light(arguments.light, avatar, own.upright)
    avatar.relight(None if light.vector is None else performance.upright[:3, :3].T @ light.vector)
    if output.suffix:
        if not 0 <= arguments.pose < len(performance):
            raise ConfigError(
                f"--pose {arguments.pose}: the motion has the frames 0 to {len(performance) - 1}"
            )
        rows = {arguments.pose: output}
    else:
        rows = {row: output / f"{row:04d}.ply" for row in range(len(performance))}
    with torch.no_grad():
        for row, path in rows.items():
            write_ply(path, posed_table(avatar, performance.pose(row), performance.upright, widen))
    print(f"{output}: {len(rows)} of {len(performance)} poses, {light.text} baked in")
