"""Coverage of pixels and the faces in them, against the z-buffer of the whole picture, pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest

from occfusion.geometry.sampled_mesh import SAMPLES, SampledMesh, box_of
from occfusion.geometry.zbuffer import rasterize_mesh

WIDTH, HEIGHT = 30, 20


def mesh(seed: int):
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([4, 3], [22, 17], (24, 2))
    return pixels, rng.uniform(1.0, 3.0, 24), rng.integers(0, 24, (15, 3))


@pytest.mark.parametrize("seed", range(4))
def test_a_window_shows_what_the_whole_picture_does(seed: int) -> None:
    pixels, depths, faces = mesh(seed)
    box = x, y, w, h = box_of(pixels, WIDTH, HEIGHT)
    drawn = SampledMesh.draw(pixels, depths, faces, box)
    seen = rasterize_mesh(SAMPLES * pixels, depths, faces, SAMPLES * WIDTH, SAMPLES * HEIGHT)
    whole, depth = seen.face, seen.depth
    for row in range(HEIGHT):
        for column in range(WIDTH):
            own = whole[SAMPLES * row :, SAMPLES * column :][:SAMPLES, :SAMPLES]
            if not (y <= row < y + h and x <= column < x + w):
                assert (own == -1).all()
                continue
            assert drawn.coverage[row - y, column - x] == (own >= 0).mean()
            assert (
                drawn.nearest[row - y, column - x]
                == depth[SAMPLES * row :, SAMPLES * column :][:SAMPLES, :SAMPLES].min()
            )
            assert drawn.face_at(np.array([[row - y, column - x]]))[0] == own.max()
    assert drawn.coverage.dtype == np.float32 and 0 < drawn.coverage.mean() < 1


@pytest.mark.parametrize(
    ("points", "box"),
    [
        ([[3.2, 4.9], [7.0, 5.1]], (3, 4, 4, 2)),
        ([[-50.0, 2.0], [1e9, 2.5]], (0, 2, 30, 1)),
        ([[40.0, 40.0], [50.0, 60.0]], (29, 19, 1, 1)),
        ([[np.nan, 2.0], [np.inf, 3.0]], (0, 0, 1, 1)),
        ([[np.nan, 2.0], [5.0, 6.0]], (5, 6, 1, 1)),
    ],
)
def test_boxes_lie_in_the_picture(points, box) -> None:
    assert box_of(np.array(points), WIDTH, HEIGHT) == box
