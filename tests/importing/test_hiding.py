"""Sources are told apart from what hides the person, and fitted again, where something does; else left alone."""

from __future__ import annotations

import numpy as np
import pytest

from occfusion.cli.import_clip import given_of
from occfusion.errors import ConfigError
from occfusion.fitting.pipeline import Fit
from occfusion.fitting.quality import measure, posed, silhouette
from occfusion.fitting.solver import Solution
from occfusion.footage.camera import find_intrinsics
from occfusion.footage.clip import Clip, Shot
from occfusion.footage.landmarks import KeyPoints
from occfusion.human import embedded_body
from occfusion.importing.hiding import told_apart
from occfusion.importing.sources import Sources

WIDTH, HEIGHT, FRAMES = 192, 256, 4


@pytest.fixture(scope="module")
def standing():
    """A fit, and the masks of the whole person."""
    body = embedded_body()
    intrinsics = find_intrinsics((WIDTH, HEIGHT), 1.0, 230.0, None)
    place = np.tile([0.0, 0.3, 2.4], (FRAMES, 1))
    solution = Solution(
        np.zeros(10), np.tile([np.pi, 0, 0], (FRAMES, 1)), np.zeros((FRAMES, 69)), place, intrinsics.K
    )
    faces = body.faces.numpy()
    whole = [silhouette(v, intrinsics.K, faces, (HEIGHT, WIDTH)) for v, _ in posed(body, solution)]
    return body, intrinsics, solution, whole


def run(standing, masks):
    body, intrinsics, solution, _ = standing
    points = KeyPoints(np.zeros((FRAMES, 33, 2)), np.zeros((FRAMES, 33)), None, np.ones(FRAMES))
    shot = Shot(
        [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * FRAMES,
        [10, 11, 12, 13],
        [0.1 * k for k in range(FRAMES)],
        1.0,
        [],
    )
    sources = Sources(Clip(None, (), FRAMES, 10.0, 0), shot, points, masks, intrinsics)
    asked = []

    def refit(seen: Sources) -> Fit:
        asked.append(seen)
        return Fit(solution, measure(body, solution, points, seen.masks or None, seen.hidden), points, [])

    first = refit(sources)
    asked.clear()
    return sources, first, *told_apart(body, sources, first, refit), asked


def test_a_person_in_full_view_is_fitted_once(standing):
    sources, first, seen, fit, asked = run(standing, standing[3])
    assert seen is sources and fit is first and not asked


def test_what_hides_is_told_to_a_second_fit_and_to_the_user(standing):
    post = np.zeros((HEIGHT, WIDTH), bool)
    post[:, 85:107] = True
    masks = [mask & ~post for mask in standing[3]]
    _, first, seen, fit, asked = run(standing, masks)
    assert [bool(one.masks) for one in asked] == [False, True]  # key points alone, then everything
    assert asked[1] is seen and fit is not first and "4 frames (10-13)" in seen.notes[-1]
    hidden = [full & post for full in standing[3]]
    assert all((a & b).sum() > 0.95 * b.sum() for a, b in zip(seen.hidden, hidden, strict=True))
    # with it known, the body lies on what is seen
    assert np.nanmedian(first.quality.iou) < 0.75 < 0.95 < np.nanmedian(fit.quality.iou)


def test_what_a_user_said_is_not_looked_for(standing):
    from argparse import Namespace

    said = Namespace(
        camera=None, focal=None, occluder="a", no_occluder=True, keypoints=None, masks=None, masks_person=None
    )
    with pytest.raises(ConfigError, match="--no-occluder"):
        given_of(said)
