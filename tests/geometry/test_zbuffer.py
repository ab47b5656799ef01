from __future__ import annotations

import numpy as np
import pytest

from occfusion.geometry.zbuffer import rasterize_mesh
from oracles.zbuffer import cast_rays

K = np.array([[30.0, 0.0, 12.3], [0.0, 28.0, 9.6], [0.0, 0.0, 1.0]])
TRIANGLE = np.array([[0, 1, 2]])


def _project(points: np.ndarray) -> np.ndarray:
    pixels = points @ K.T
    return pixels[:, :2] / pixels[:, 2:]


def test_agrees_with_ray_casting_on_a_soup_of_triangles() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform([-0.8, -0.6, 1.0], [0.8, 0.6, 3.0], (45, 3))
    faces = rng.permutation(45).reshape(15, 3)
    depth, face, weights, margin = cast_rays(points, faces, K, 24, 20)
    seen = rasterize_mesh(_project(points), points[:, 2], faces, 24, 20)
    clear = margin > 1e-9
    assert clear.mean() > 0.99
    assert 0.3 < (face >= 0).mean() < 1.0  # the case has both surface and void
    np.testing.assert_array_equal(seen.face[clear], face[clear])
    np.testing.assert_allclose(seen.depth[clear], depth[clear], rtol=1e-6)
    np.testing.assert_allclose(seen.barycentrics[clear], weights[clear], atol=1e-6)


def test_barycentrics_give_back_the_point_on_the_ray() -> None:
    points = np.array([[-0.9, -0.6, 1.0], [1.2, -0.5, 4.0], [0.0, 1.0, 2.0]])  # steep: perspective matters
    seen = rasterize_mesh(_project(points), points[:, 2], TRIANGLE, 24, 20)
    rows, columns = np.nonzero(seen.face == 0)
    assert len(rows) > 50
    surface = seen.barycentrics[rows, columns].astype(np.float64) @ points
    np.testing.assert_allclose(_project(surface), np.stack([columns, rows], 1) + 0.5, atol=1e-4)
    np.testing.assert_allclose(surface[:, 2], seen.depth[rows, columns], rtol=1e-6)


def test_window_is_the_slice_of_the_whole() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([-1, -1, 1], [1, 1, 2], (30, 3))
    faces = np.arange(30).reshape(10, 3)
    whole = rasterize_mesh(_project(points), points[:, 2], faces, 24, 20)
    part = rasterize_mesh(_project(points) - [5, 3], points[:, 2], faces, 9, 11)
    np.testing.assert_array_equal(part.face, whole.face[3:14, 5:14])


def test_of_equal_depths_the_first_face_is_seen() -> None:
    points = np.array([[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0], [0.0, 1.0, 2.0]])
    seen = rasterize_mesh(_project(points), points[:, 2], np.array([[0, 1, 2], [0, 1, 2]]), 24, 20)
    assert set(np.unique(seen.face)) == {-1, 0}


@pytest.mark.stiff
@pytest.mark.parametrize("scale", [1e-9, 1e6, 1e30])
def test_extreme_triangles_stay_inside_the_picture(scale: float) -> None:
    pixels = (np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]) - 0.3) * scale + 10.0
    seen = rasterize_mesh(pixels, np.ones(3), TRIANGLE, 24, 20)
    assert np.isfinite(seen.barycentrics).all()
    assert ((seen.face == 0) == np.isfinite(seen.depth)).all()


@pytest.mark.stiff
def test_what_is_behind_infinite_or_undefined_is_left_out() -> None:
    pixels = np.array([[2.0, 2.0], [20.0, 3.0], [8.0, 18.0]])
    assert (rasterize_mesh(pixels, np.ones(3), TRIANGLE, 24, 20).face == 0).any()
    for depth in (-1.0, 0.0, np.nan):
        assert (rasterize_mesh(pixels, np.array([1.0, 1.0, depth]), TRIANGLE, 24, 20).face == -1).all()
    for bad in (np.nan, np.inf):
        broken = pixels.copy()
        broken[1, 0] = bad
        assert (rasterize_mesh(broken, np.ones(3), TRIANGLE, 24, 20).face == -1).all()


def test_wrong_shapes_and_faces_are_refused() -> None:
    pixels = np.zeros((3, 2))
    with pytest.raises(ValueError, match="faces name vertices"):
        rasterize_mesh(pixels, np.ones(3), np.array([[0, 1, 3]]), 4, 4)
    with pytest.raises(ValueError, match="pixels must be"):
        rasterize_mesh(pixels, np.ones(2), TRIANGLE, 4, 4)
    with pytest.raises(ValueError, match="faces must be"):
        rasterize_mesh(pixels, np.ones(3), np.array([[0, 1]]), 4, 4)


def test_nothing_to_draw_gives_an_empty_buffer() -> None:
    seen = rasterize_mesh(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3), int), 4, 3)
    assert seen.depth.shape == (3, 4) and np.isinf(seen.depth).all()
    assert (seen.barycentrics == 0).all()
