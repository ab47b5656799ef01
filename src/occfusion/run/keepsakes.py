"""What a run leaves for people beside its figures: a film of one turn, and the video above what came of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from occfusion.evaluation.pictures import captioned, to_uint8
from occfusion.files.atomic import write_png
from occfusion.files.run_folder import RunFolder
from occfusion.files.video import write_frames
from occfusion.human import Avatar
from occfusion.human.rendering import Renderer
from occfusion.run.loaded import load_run
from occfusion.run.showing import MotionChoice, make_showing
from occfusion.show.film import parse_background, picture_of
from occfusion.types import Frame

TURN_SECONDS = 4.0
TURNTABLE_SIZE = 320
"""Pixels."""


def write_turntable(folder: RunFolder, frames: int) -> None:
    """Writes one turn around the avatar that a run has saved, as a film that browsers and pages play.

    Args:
        folder: of the run.
        frames: pictures of the turn.

    Raises:
        OccfusionError: the disk refuses.
    """
    size = (TURNTABLE_SIZE, TURNTABLE_SIZE)
    showing = make_showing(
        load_run(folder.path),
        "turntable",
        MotionChoice(),
        size=size,
        frames=frames,
        renderer=Renderer("auto"),
    )
    black = parse_background("black", *size)
    pictures = (picture_of(showing.painter.draw(shot), "rgb", black, None) for shot in showing.shots)
    write_frames(folder.turntable, pictures, frames / TURN_SECONDS)


@torch.inference_mode()
def write_before_after(
    folder: RunFolder, avatar: Avatar, frames: Sequence[Frame], renderer: Renderer
) -> None:
    """Writes training frames as the video has them, each above the avatar in the same pose and camera.

    Raises:
        OccfusionError: the disk refuses.
    """
    columns = [
        np.concatenate(
            [
                captioned(to_uint8(frame.rgb), f"video, {frame.name}"),
                captioned(to_uint8(renderer.frame(avatar, frame).rgb), "avatar"),
            ]
        )
        for frame in frames
    ]
    height = max(column.shape[0] for column in columns)
    padded = [np.pad(column, ((0, height - column.shape[0]), (0, 0), (0, 0))) for column in columns]
    write_png(folder.before_after, np.concatenate(padded, axis=1))
