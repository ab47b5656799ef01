"""A still picture is one also after compression has changed it from frame to frame."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from occfusion.errors import DataError
from occfusion.files.video import write_frames
from occfusion.footage.clip import open_clip, read_clip
from occfusion.importing.sources import Choice, read_pictures


def frames(moves: bool) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.integers(0, 255, (240, 320, 3)).astype(np.uint8), (0, 0), 2.0) * 2
    out = []
    for k in range(20):
        picture = wall.copy()
        left = 100 + (k if moves else 0)
        picture[100:160, left : left + 20] = (220, 30, 40)
        out.append(picture)
    return out


def test_a_still_picture_as_a_video_is_refused(tmp_path):
    write_frames(tmp_path / "still.mp4", frames(moves=False), 10.0)
    seen = read_clip(open_clip(tmp_path / "still.mp4")).pictures
    assert np.abs(seen[0].astype(int) - seen[-1]).max() > 2  # compression changed it
    with pytest.raises(DataError, match="still picture"):
        read_pictures(tmp_path / "still.mp4", Choice())


def test_something_small_that_moves_is_enough(tmp_path):
    write_frames(tmp_path / "moving.mp4", frames(moves=True), 10.0)
    assert len(read_pictures(tmp_path / "moving.mp4", Choice())[1]) == 20
