"""`occfusion synth OUT`: writes embedded scenes to disk in ZJU-MoCap's layout."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from occfusion.synth import (
    HELD_OUT_FROM,
    LEVELS,
    LIGHTS,
    OCCLUDERS,
    VIEWS,
    SceneSpec,
    with_turn,
    write_scene,
)
from occfusion.synth.spec import MAX_CAMERAS, MAX_SIZE


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the verb's arguments."""
    default = SceneSpec()
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of scenes; OUT/SCENE is written")
    parser.add_argument(
        "--scene",
        nargs="+",
        default=["001-clean"],
        metavar="NNN-LEVEL[-WORDS]",
        help=f"subject number ({HELD_OUT_FROM} and up are held out from all training and tuning), level "
        f"({', '.join(LEVELS)}), and words: occluders ({', '.join(OCCLUDERS[1:])}), who does not turn "
        f"({', '.join(VIEWS)}), sit, shortN for the first N frames; one or more (default: 001-clean)",
    )
    parser.add_argument(
        "--size", type=int, default=default.image_size, help=f"pixels, up to {MAX_SIZE} (%(default)s)"
    )
    parser.add_argument(
        "--frames", type=int, default=default.frames, help="moments, 0.1 s apart (%(default)s)"
    )
    parser.add_argument("--cameras", type=int, default=MAX_CAMERAS, help="of the ring (%(default)s)")
    parser.add_argument("--light", choices=LIGHTS, default=default.light, help="(%(default)s)")
    parser.add_argument(
        "--turn",
        type=int,
        help="degrees that the person turns, to and fro; 360: all round (default: by the name)",
    )
    parser.add_argument(
        "--facing", type=int, help="side that the first camera sees: 0 front, 180 back (default: by the name)"
    )
    parser.add_argument("--seed", type=int, default=default.seed, help="of motion and errors (%(default)s)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def run(args: argparse.Namespace) -> int:
    """Writes the scenes; returns the exit code."""
    specs = [
        replace(
            with_turn(SceneSpec.parse(name), args.turn, args.facing),
            image_size=args.size,
            frames=args.frames,
            cameras=args.cameras,
            light=args.light,
            seed=args.seed,
        )
        for name in args.scene
    ]
    for spec in specs:
        print(write_scene(args.out, spec, progress=not args.quiet))
    return 0
