"""Draws what each part of the system adds: input, `A`, `D`, `E`, truth.

    python scripts/draw_before_after.py OUTPUT.png RUN_OF_A RUN_OF_D RUN_OF_E [...]

Runs of the same scene in threes. For each three one training frame, cut to the person, and one held-out view
(with no input).
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.evaluation.pictures import captioned, to_uint8
from occfusion.files.atomic import write_png
from occfusion.human import Avatar
from occfusion.human.rendering import Renderer
from occfusion.run.loaded import load_run
from occfusion.run.prepare import make_body, make_data
from occfusion.types import Frame

MARGIN = 0.08  # of the person's height
HEIGHT = 300


def main(output: Path, runs: list[Path]) -> None:
    """Writes the picture."""
    rows = []
    for three in zip(runs[::3], runs[1::3], runs[2::3], strict=True):
        loaded = [load_run(run) for run in three]
        settings = loaded[-1].settings
        data = make_data(settings, make_body(settings.body))
        data.setup()
        avatars = [run.avatar for run in loaded]
        rows.append(draw_row(data.spread_train_frames(5)[1], avatars, True))
        rows.append(draw_row(data.spread_test_frames(9)[4], avatars, False))
    width = max(row.shape[1] for row in rows)
    write_png(
        output, np.concatenate([np.pad(row, ((0, 4), (0, width - row.shape[1]), (0, 0))) for row in rows])
    )


def draw_row(frame: Frame, avatars: list[Avatar], is_input: bool) -> NDArray[np.uint8]:
    """Returns one row of pictures."""
    assert frame.truth is not None
    seen = frame.rgb * frame.visible_mask[..., None] if is_input else torch.zeros_like(frame.rgb)
    renderer = Renderer("torch")
    renderings = [renderer.frame(avatar.eval(), frame).rgb.clamp(0.0, 1.0) for avatar in avatars]
    pictures = [seen, *renderings, frame.truth.rgb]
    names = ["input" if is_input else "held out", "A", "D", "E", "truth"]
    return np.concatenate(
        [
            captioned(cut(to_uint8(picture), frame), name)
            for picture, name in zip(pictures, names, strict=True)
        ],
        axis=1,
    )


def cut(picture: NDArray[np.uint8], frame: Frame) -> NDArray[np.uint8]:
    """Returns the square around the person, enlarged."""
    assert frame.truth is not None
    ys, xs = np.nonzero(frame.truth.mask.numpy())
    half = int((0.5 + MARGIN) * max(np.ptp(ys), np.ptp(xs)))
    y, x = int(ys.min() + ys.max()) // 2, int(xs.min() + xs.max()) // 2
    padded = np.pad(picture, ((half, half), (half, half), (0, 0)))
    return cv2.resize(
        padded[y : y + 2 * half, x : x + 2 * half], (HEIGHT, HEIGHT), interpolation=cv2.INTER_AREA
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(argument) for argument in sys.argv[2:]])
