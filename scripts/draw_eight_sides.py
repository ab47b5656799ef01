"""Draws avatars from eight sides, a row each.

python scripts/draw_eight_sides.py OUTPUT.png RUN [RUN ...] [--size 200]

The first side is the front of the first frame's pose; the others follow in steps of 45 degrees.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from occfusion.evaluation.pictures import captioned
from occfusion.files.atomic import write_png
from occfusion.human.rendering import Renderer
from occfusion.run.loaded import load_run
from occfusion.run.showing import MotionChoice, make_showing
from occfusion.show.film import parse_background, picture_of

SIDES = 8


def row(run: Path, size: int) -> NDArray[np.uint8]:
    """Returns the eight pictures of an avatar beside each other, cut to the columns that it reaches."""
    showing = make_showing(
        load_run(run), "turntable", MotionChoice(), size=(size, size), frames=SIDES, renderer=Renderer("auto")
    )
    grey = parse_background("grey", size, size)
    pictures = [picture_of(showing.painter.draw(shot), "rgb", grey, None)[..., :3] for shot in showing.shots]
    return np.concatenate([picture[:, size // 5 : -size // 5] for picture in pictures], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--size", type=int, default=200, help="height of a picture, pixels (200)")
    arguments = parser.parse_args()
    rows = [
        captioned(row(run, arguments.size), f"{run.resolve().parent.name}, {run.resolve().name}")
        for run in arguments.runs
    ]
    write_png(arguments.output, np.concatenate(rows))


if __name__ == "__main__":
    main()
