"""What a run leaves to be looked at."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageSequence

from occfusion.evaluation.pictures import CAPTION_HEIGHT
from occfusion.files.images import read_rgb
from occfusion.files.run_folder import RunFolder


def test_a_run_leaves_a_turntable_and_a_strip_of_video_above_avatar(
    train: Callable[..., tuple[Path, dict[str, Any]]],
) -> None:
    folder, _ = train(
        "stage=optim", "optim.steps=2", "evaluation.turntable=3", "evaluation.curve=false",
        "evaluation.training_views=false",
    )  # fmt: skip
    left = RunFolder(folder)
    with Image.open(left.turntable) as film:
        turns = [np.asarray(turn.convert("RGB")).astype(int) for turn in ImageSequence.Iterator(film)]
    assert len(turns) == 3 and all(turn.max() > 60 for turn in turns)
    assert np.abs(turns[0] - turns[1]).mean() > 0.5
    strip = read_rgb(left.before_after)
    side = strip.shape[0] // 2
    assert strip.shape[1] % (side - CAPTION_HEIGHT) == 0 and strip[CAPTION_HEIGHT:side].max() > 60
    assert strip[side + CAPTION_HEIGHT :].max() > 60
    report = left.report.read_text(encoding="utf-8")
    assert "pictures/turntable.webp" in report and "pictures/before_after.png" in report
