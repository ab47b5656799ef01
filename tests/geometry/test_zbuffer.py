from __future__ import annotations

import numpy as np
import pytest
import trimesh

from occfusion.geometry.zbuffer import nearest_faces, rasterize_mesh
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


def every_centre(pixels, depths, faces, width, height):
    """All centres against each triangle in turn, with the arithmetic that is written down; exact to the bit."""
    depth = np.full((height, width), np.inf, np.float32)
    face = np.full((height, width), -1)
    x, y = np.arange(width)[None] + 0.5, np.arange(height)[:, None] + 0.5
    for f, (i, j, k) in enumerate(faces):
        (xi, yi), (xj, yj), (xk, yk) = pixels[i], pixels[j], pixels[k]
        area = (xj - xi) * (yk - yi) - (yj - yi) * (xk - xi)
        if not abs(area) > 1e-12:
            continue
        inverse = 1.0 / area
        a = ((xj - x) * (yk - y) - (yj - y) * (xk - x)) * inverse
        b = ((xk - x) * (yi - y) - (yk - y) * (xi - x)) * inverse
        c = 1.0 - a - b
        bounds = [(min(v), max(v)) for v in ((xi, xj, xk), (yi, yj, yk))]
        near = (x >= bounds[0][0]) & (x <= bounds[0][1]) & (y >= bounds[1][0]) & (y <= bounds[1][1])
        inside = near & (a >= 0) & (b >= 0) & (c >= 0)
        with np.errstate(divide="ignore"):
            z = 1.0 / (a * (1.0 / depths[i]) + b * (1.0 / depths[j]) + c * (1.0 / depths[k]))
        closer = inside & (z < depth)
        depth[closer], face[closer] = z[closer], f
    return depth, face


def scattered(rng, count, sides):
    """Triangles about pixel centres, with corners so far from them in x and y."""
    return (
        np.repeat(rng.integers(0, 24, (count // 3, 2)) + 0.5, 3, axis=0) + rng.normal(size=(count, 2)) * sides
    )


def level(rng, count):
    """Triangles with a side that runs along the centres of a row, but for a billionth."""
    points = rng.uniform(0.0, 24.0, (count, 2))
    points[1::3, 1] = points[::3, 1] = np.floor(points[::3, 1]) + 0.5
    points[1::3, 1] += 1e-9 * rng.normal(size=count // 3)
    return points


KINDS = {
    "soup": lambda rng, count: rng.uniform(-4.0, 30.0, (count, 2)),
    "small": lambda rng, count: scattered(rng, count, [1.0, 1.0]),
    "low": lambda rng, count: scattered(rng, count, [9.0, 1e-4]),
    "narrow": lambda rng, count: scattered(rng, count, [1e-4, 9.0]),
    "tiny": lambda rng, count: scattered(rng, count, [1e-5, 1e-5]),
    "level": level,
    "on centres": lambda rng, count: rng.integers(-2, 26, (count, 2)) + 0.5,
    "on corners": lambda rng, count: rng.integers(-2, 26, (count, 2)).astype(float),
    "large": lambda rng, count: rng.normal(size=(count, 2)) * 9e4,
    "huge": lambda rng, count: rng.normal(size=(count, 2)) * 1e12,
}


@pytest.mark.stiff
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_no_centre_is_missed_whatever_the_triangle(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels, depths = KINDS[kind](rng, 300), rng.uniform(1.0, 3.0, 300)
    faces = np.arange(300).reshape(100, 3)
    seen = nearest_faces(pixels, depths, faces, 25, 23)
    depth, face = every_centre(pixels, depths, faces, 25, 23)
    np.testing.assert_array_equal(seen.face, face)
    np.testing.assert_array_equal(seen.depth, depth)
    assert (face >= 0).any()


def ring(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A torus, turned, whose parts lie before each other, and dented so that some of it is inside out."""
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=30, minor_sections=14)
    rng = np.random.default_rng(seed)
    points = np.asarray(mesh.vertices) @ trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    points += 0.06 * seed * rng.normal(size=points.shape)
    return points + np.array([0.0, 0.0, 6.0]), np.asarray(mesh.faces)


@pytest.mark.parametrize("seed", range(6))
def test_of_a_closed_mesh_what_is_seen_from_behind_may_be_left_out(seed: int) -> None:
    """As much is covered; where nothing is inside out (seed 0), the very same is seen."""
    points, faces = ring(seed)
    camera = np.array([[90.0, 0.0, 32.3], [0.0, 90.0, 29.6], [0.0, 0.0, 1.0]])
    pixels = points @ camera.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    every = rasterize_mesh(pixels, points[:, 2], faces, 64, 60)
    whole = nearest_faces(pixels, points[:, 2], faces, 64, 60)
    front = nearest_faces(pixels, points[:, 2], faces, 64, 60, closed=True)
    np.testing.assert_array_equal(whole.face, every.face)
    np.testing.assert_array_equal(whole.depth, every.depth)
    assert 0.1 < (whole.face >= 0).mean() < 0.8
    np.testing.assert_array_equal(front.face >= 0, whole.face >= 0)
    assert (front.depth >= whole.depth).all()
    if seed == 0:
        np.testing.assert_array_equal(front.depth, whole.depth)
        np.testing.assert_array_equal(front.face, whole.face)


def test_a_closed_mesh_that_reaches_to_the_camera_is_seen_from_within() -> None:
    """It is cut open there: what is seen of it is its back."""
    mesh = trimesh.creation.icosphere(subdivisions=3)
    points, faces = np.asarray(mesh.vertices) + np.array([0.0, 0.0, 0.5]), np.asarray(mesh.faces)
    pixels = np.zeros((len(points), 2))
    ahead = points[:, 2] > 0.01
    pixels[ahead] = 30.0 * points[ahead, :2] / points[ahead, 2:] + 12.0
    whole = nearest_faces(pixels, points[:, 2], faces, 24, 24)
    assert (whole.face >= 0).mean() > 0.9
    front = nearest_faces(pixels, points[:, 2], faces, 24, 24, closed=True)
    np.testing.assert_array_equal(front.face, whole.face)
