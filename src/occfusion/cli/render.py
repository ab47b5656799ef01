"""`python -m occfusion render RUN... --path turntable --output FILE`: a trained avatar from any camera."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import track

from occfusion.errors import ConfigError, DataError
from occfusion.files.video import STILL, check_destination, write_folder, write_frames
from occfusion.human.rendering import Renderer
from occfusion.motion import EMBEDDED_CLIPS, USUAL_FPS
from occfusion.run.loaded import LoadedRun, load_run
from occfusion.run.showing import (
    MOVING_PATHS,
    PATHS,
    MotionChoice,
    Showing,
    inputs_of,
    make_showing,
    run_names,
)
from occfusion.show.drawing import LAYERS
from occfusion.show.film import TRANSPARENT, Picture, parse_background, picture_of, side_by_side
from occfusion.show.views import MOST_PIXELS

LEAST_SIZE = 8
_DEPTHS = 0.6
"""Metres before and behind the person's middle that the greys of a film's depth stand for."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument(
        "runs", type=Path, nargs="+", metavar="RUN", help="run folders; several: side by side"
    )
    parser.add_argument(
        "--path", default="turntable",
        help=f"{', '.join(PATHS)}, or a file of cameras (.json); train: beside the input. Default: turntable",
    )  # fmt: skip
    parser.add_argument(
        "--motion",
        help=f"sequence, {', '.join(EMBEDDED_CLIPS)}, another run, or a file (AMASS, AIST++, .npz). Default: the first "
        "pose stands, on paths of the run's own cameras its sequence",
    )
    parser.add_argument(
        "--output", type=Path, required=True,
        help="a .mp4, .avi or animated .webp file, a .png of one picture, or a folder for numbered .png files",
    )  # fmt: skip
    parser.add_argument(
        "--layers", nargs="+", choices=LAYERS, default=["rgb"], metavar="LAYER",
        help="rgb, alpha, depth, normals: beside each other in a film, each in its folder as .png (depth in mm)",
    )  # fmt: skip
    parser.add_argument(
        "--size", help="pixels, such as 512 or 641x361. Default: 512, of given cameras their own"
    )
    parser.add_argument("--frames", type=int, help="pictures. Default: 120, of a motion as many as it has")
    parser.add_argument("--fps", type=float, help="frames a second of the film; a motion is resampled to it")
    parser.add_argument("--motion-fps", type=float, help="frames a second of a motion that does not say")
    parser.add_argument(
        "--start", type=float, default=0.0, help="seconds of the motion to leave out at its start"
    )
    parser.add_argument("--seconds", type=float, help="how much of the motion to show")
    parser.add_argument(
        "--moment", type=int, help="frame at which time stands, for bullet-time. Default: the middle"
    )
    behind = parser.add_mutually_exclusive_group()
    behind.add_argument(
        "--background", default="black", help="black, white, grey, #rrggbb, transparent, or a picture's file"
    )
    behind.add_argument("--white", action="store_true", help="the same as --background white")
    parser.add_argument(
        "--light", default="estimated",
        help="even; estimated (from the video, the default); or a lamp at AZIMUTH,HEIGHT in degrees, such as 45,30",
    )  # fmt: skip
    parser.add_argument(
        "--stage", choices=("optim", "refine"), help="the avatar of that stage. Default: the last"
    )


def run(arguments: argparse.Namespace) -> int:
    """Renders and writes; returns the exit code."""
    size = _check(arguments)
    words = "white" if arguments.white else arguments.background
    check_destination(arguments.output, alpha=words == TRANSPARENT)
    renderer = Renderer("auto")
    loaded = [load_run(folder, arguments.stage) for folder in arguments.runs]
    for one in loaded:
        if one.remark:
            print(one.remark, file=sys.stderr)
    motion = MotionChoice(
        arguments.motion, arguments.motion_fps, arguments.fps, arguments.start, arguments.seconds
    )
    showings = [
        make_showing(
            one, arguments.path, motion, light=arguments.light, size=size, frames=arguments.frames,
            moment=arguments.moment, renderer=renderer,
        )
        for one in loaded
    ]  # fmt: skip
    count = min(len(showing.shots) for showing in showings)
    if count > 1 and arguments.output.suffix.lower() == STILL:
        raise ConfigError(
            f"--output {arguments.output}: a .png holds one picture, and these are {count}; add --frames 1, or name a "
            "folder"
        )
    fps = arguments.fps or next((s.fps for s in showings if s.fps is not None), USUAL_FPS)
    films = _films(arguments, words, loaded, showings, count, size)
    told = track(films, escape(arguments.path), total=count, console=Console(stderr=True))
    if arguments.output.suffix == "" and len(arguments.layers) > 1:
        write_folder(arguments.output, told, arguments.layers)
    else:
        write_frames(arguments.output, (side_by_side(each, []) for each in told), fps)
    is_film = arguments.output.suffix.lower() not in ("", STILL)
    pace = f", {fps:g} a second" if is_film and count > 1 else ""
    print(f"{arguments.output}: {count} picture{'' if count == 1 else 's'}{pace}")
    return 0


def _check(arguments: argparse.Namespace) -> tuple[int, int] | None:
    """Returns the size that is asked for, None where none is."""
    if arguments.frames is not None and not 1 <= arguments.frames <= 100_000:
        raise ConfigError(f"--frames {arguments.frames}: from 1 to 100000")
    for name in ("fps", "motion_fps", "seconds"):
        value = getattr(arguments, name)
        if value is not None and not 0 < value <= 100_000:
            raise ConfigError(f"--{name.replace('_', '-')} {value:g}: must be positive")
    if not math.isfinite(arguments.start) or arguments.start < 0:
        raise ConfigError(f"--start {arguments.start:g}: seconds, 0 or more")
    _check_used(arguments)
    if arguments.size is None:
        return None
    try:
        sides = [int(word) for word in str(arguments.size).lower().split("x")]
    except ValueError:
        sides = []
    if len(sides) == 1:
        sides *= 2
    if len(sides) != 2 or not all(LEAST_SIZE <= side <= MOST_PIXELS for side in sides):
        raise ConfigError(
            f"--size {arguments.size}: one side of a square or WIDTHxHEIGHT, {LEAST_SIZE} to {MOST_PIXELS} pixels "
            "each, such as 512 or 640x360"
        )
    return sides[0], sides[1]


def _check_used(arguments: argparse.Namespace) -> None:
    """Refuses options that the path or the output would leave without effect."""
    path = arguments.path
    if path == "canonical" and arguments.motion is not None:
        raise ConfigError(
            f"--path canonical shows the rest pose, which has no motion; leave out --motion {arguments.motion}, or "
            "take --path turntable"
        )
    if arguments.moment is not None and path != "bullet-time":
        raise ConfigError(f"--moment is for --path bullet-time; time does not stand on --path {path}")
    cut = arguments.start != 0.0 or arguments.seconds is not None or arguments.motion_fps is not None
    moves = arguments.motion is not None or path in MOVING_PATHS or path not in PATHS
    if cut and not moves:
        raise ConfigError(
            "--start, --seconds and --motion-fps choose a part of a motion, and nothing moves; add --motion sequence "
            "or another"
        )
    if arguments.output.suffix.lower() == STILL and "depth" in arguments.layers and len(arguments.layers) > 1:
        raise ConfigError(
            f"{arguments.output}: depth in millimetres has no room beside other layers in one .png; name a folder"
        )


def _films(
    arguments: argparse.Namespace,
    words: str,
    loaded: Sequence[LoadedRun],
    showings: Sequence[Showing],
    count: int,
    size: tuple[int, int] | None,
) -> Iterator[list[Picture]]:
    """Yields the pictures of each layer, runs side by side."""
    is_film = arguments.output.suffix.lower() not in ("", STILL)
    names = run_names([one.folder.path for one in loaded]) if len(loaded) > 1 else []
    layers, first = arguments.layers, showings[0]
    beside = arguments.path == "train" and bool(first.views)
    inputs = inputs_of(loaded[0], first.views[:count], size) if beside else None
    if beside:
        names = ["input", *(names or [loaded[0].stage])]
    backgrounds = {}
    for number in range(count):
        drawn = [each.painter.draw(each.shots[number], normals="normals" in layers) for each in showings]
        shown = next(inputs) if inputs is not None else None
        columns: list[Picture] = []
        for layer in layers:
            pictures = []
            for showing, each in zip(showings, drawn, strict=True):
                camera = showing.shots[number].camera
                key = (camera.width, camera.height)
                if key not in backgrounds:
                    backgrounds[key] = parse_background(words, *key)
                depths = _range_of(showing, number) if is_film else None
                pictures.append(picture_of(each, layer, backgrounds[key], depths))
            if shown is not None:
                pictures.insert(0, shown)
            if layer == "depth" and not is_film and len(pictures) > 1:
                raise DataError(
                    "depth in millimetres is written of one run at a time; name one run, or a film"
                )
            columns.append(side_by_side(pictures, names))
        yield columns


def _range_of(showing: Showing, number: int) -> tuple[float, float]:
    """Returns the depths that a film's greys stand for: around the person's root."""
    shot, performance = showing.shots[number], showing.painter.performance
    place = performance.pose(shot.row or 0).transl
    depth = float(shot.camera.viewmat[2, :3] @ place + shot.camera.viewmat[2, 3])
    return max(depth - _DEPTHS, 0.01), depth + _DEPTHS
