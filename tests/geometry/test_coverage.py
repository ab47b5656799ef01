"""How often and from where places of a surface are seen, against lines of sight and loops."""

from __future__ import annotations

import numpy as np
import pytest

from occfusion.geometry.coverage import (
    CONE,
    GRAZING,
    MANY,
    MOST,
    ONE,
    UNSEEN,
    Coverage,
    Sighting,
    class_picture,
    cover,
    looks,
    surface_frames,
    vertex_areas,
)
from occfusion.geometry.zbuffer import rasterize_mesh
from oracles import coverage as oracle

SIZE = 200


def ball(radius: float, centre, rings: int = 9, sectors: int = 14):
    """Vertices and faces of a ball, corners counter-clockwise from outside."""
    polar = np.linspace(0, np.pi, rings + 2)[1:-1]
    around = np.linspace(0, 2 * np.pi, sectors, endpoint=False)
    points = [(0.0, 0.0, 1.0)]
    points += [(np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)) for p in polar for a in around]
    points.append((0.0, 0.0, -1.0))
    faces = []
    for s in range(sectors):
        n = (s + 1) % sectors
        faces.append((0, 1 + s, 1 + n))
        for r in range(rings - 1):
            a, b = 1 + r * sectors, 1 + (r + 1) * sectors
            faces += [(a + s, b + s, b + n), (a + s, b + n, a + n)]
        last = 1 + (rings - 1) * sectors
        faces.append((len(points) - 1, last + n, last + s))
    return radius * np.array(points) + np.asarray(centre, float), np.array(faces)


def two_balls():
    """A ball, and a smaller one beside it towards +x."""
    a, faces_a = ball(0.5, (0, 0, 0))
    b, faces_b = ball(0.2, (1.0, 0.1, 0.0))
    return np.concatenate([a, b]), np.concatenate([faces_a, faces_b + len(a)])


def viewmat(angle: float, distance: float = 4.0):
    """A camera that goes round the z axis, looks at the origin, and has z upwards."""
    eye = distance * np.array([np.cos(angle), np.sin(angle), 0.0])
    forward = -eye / distance
    right = np.cross(forward, [0, 0, 1.0])
    R = np.stack([right, np.cross(forward, right), forward])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, -R @ eye
    return out


K = np.array([[280.0, 0, SIZE / 2], [0, 280.0, SIZE / 2], [0, 0, 1]])
ALL = np.ones((SIZE, SIZE), bool)


def view(points, angle, visible=ALL):
    return Sighting.through(points, viewmat(angle), K, visible)


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.0, np.pi])
def test_looks_are_the_cosines_of_what_a_line_of_sight_reaches(angle):
    points, faces = two_balls()
    found, _ = looks(view(points, angle), faces)
    eye = -viewmat(angle)[:3, :3].T @ viewmat(angle)[:3, 3]
    wrong = 0
    for k, point in enumerate(points):
        towards = (eye - point) / np.linalg.norm(eye - point)
        cosine = float(oracle.normal(k, points, faces) @ towards)
        expected = cosine if cosine > GRAZING and oracle.sees(point, eye, points, faces) else 0.0
        if abs(found[k] - expected) > 1e-6:
            wrong += 1
            assert min(found[k], expected) == 0.0  # seen or not seen; never another cosine
    assert wrong <= 0.02 * len(points)  # half a pixel at the smaller ball's outline
    assert (found > 0).sum() > 30


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0])
def test_directions_are_those_to_the_camera_in_the_frame_of_each_place(angle):
    points, faces = two_balls()
    centre = -viewmat(angle)[:3, :3].T @ viewmat(angle)[:3, 3]
    towards = centre - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    wanted = np.array(
        [frame @ own for frame, own in zip(surface_frames(points, faces), towards, strict=True)]
    )
    np.testing.assert_allclose(looks(view(points, angle), faces)[1], wanted, atol=1e-12)


def test_a_closed_body_is_seen_the_same_where_its_back_is_left_out():
    points, faces = two_balls()
    views = [view(points, angle) for angle in (0.0, 0.3, 2.0, np.pi)]
    whole, closed = (cover(views, faces, closed=closed) for closed in (False, True))
    assert whole is not None and closed is not None and (whole.looks > 0).any()
    for name in ("looks", "spread", "moments", "passes"):
        np.testing.assert_array_equal(getattr(closed, name), getattr(whole, name))


def test_what_the_mask_hides_is_not_seen():
    points, faces = ball(0.5, (0, 0, 0))
    left = ALL.copy()
    left[:, : SIZE // 2] = False
    whole, _ = looks(view(points, 0.4), faces)
    half, _ = looks(view(points, 0.4, left), faces)
    column = view(points, 0.4).pixels[:, 0]
    np.testing.assert_array_equal(half > 0, (whole > 0) & (np.floor(column) >= SIZE // 2))
    nothing, _ = looks(view(points, 0.4, np.zeros_like(ALL)), faces)
    assert not nothing.any()


def test_spread_is_the_cone_of_the_directions():
    points, faces = ball(0.5, (0, 0, 0))
    angles = np.radians([-50, -30, -8, 0, 10, 15, 40])
    found = cover([view(points, a) for a in angles], faces)
    one = [looks(view(points, a), faces)[0] for a in angles]
    for k in range(len(points)):
        seen = [(a, w[k]) for a, w in zip(angles, one, strict=True) if w[k] > 0]
        assert found.looks[k] == pytest.approx(sum(w for _, w in seen), abs=1e-5)
        if not seen:
            assert np.isnan(found.spread[k])
            continue
        # the ball stands still, so directions in the world are directions on it
        eyes = [np.linalg.inv(viewmat(a))[:3, 3] - points[k] for a, _ in seen]
        directions = [eye / np.linalg.norm(eye) for eye in eyes]
        expected = oracle.cone(directions, [w for _, w in seen], MOST)
        assert found.spread[k] == pytest.approx(expected, abs=0.1)


def test_turning_the_body_is_going_round_it():
    """The same directions, whether the camera goes round or the body turns; the same classes, then."""
    points, faces = two_balls()
    angles = np.radians(np.arange(0, 180, 15))
    gone_round = cover([view(points, a) for a in angles], faces)
    turned = []
    for a in angles:
        c, s = np.cos(-a), np.sin(-a)
        turned.append(view(points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]).T, 0.0))
    turned = cover(turned, faces)
    np.testing.assert_allclose(gone_round.looks, turned.looks, atol=1e-4)
    np.testing.assert_allclose(gone_round.spread, turned.spread, atol=0.1)


def test_classes():
    """From one side: one direction; from all sides: many; what no camera faces: not at all."""
    points, faces = ball(0.5, (0, 0, 0))
    still = cover([view(points, 0.02 * k) for k in range(-5, 6)], faces).classes
    facing = points[:, 0] > 0.25
    behind = points[:, 0] < 0
    assert set(still[facing]) == {ONE} and set(still[behind]) == {UNSEEN}
    all_round = cover([view(points, a) for a in np.linspace(0, 2 * np.pi, 24)], faces).classes
    belt = np.abs(points[:, 2]) < 0.3
    assert set(all_round[belt]) == {MANY}
    assert set(all_round[np.abs(points[:, 2]) > 0.499]) == {UNSEEN}  # poles: all looks graze
    edge = Coverage(
        1, np.array([0.49, 0.51, 9.0]), np.array([90.0, CONE, CONE + 0.1]), *np.zeros((2, 3, 3, 3))
    )
    assert edge.classes.tolist() == [UNSEEN, ONE, MANY]


def test_no_view_gives_no_coverage():
    assert cover([], two_balls()[1]) is None


def test_a_body_out_of_the_picture_or_behind_is_not_seen():
    points, faces = ball(0.5, (0, 0, 0))
    for shift in ([0, 30.0, 0], [9.0, 0, 0], [1e9, 1e9, 1e9]):
        found, _ = looks(view(points + np.array(shift), 0.0), faces)
        assert not found.any()


def test_frames_are_rotations_that_turn_with_the_surface():
    points, faces = two_balls()
    frames = surface_frames(points, faces)
    np.testing.assert_allclose(
        frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (len(points), 1, 1)), atol=1e-9
    )
    assert np.linalg.det(frames) == pytest.approx(np.ones(len(points)))
    turn, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    np.testing.assert_allclose(surface_frames(points @ turn.T, faces), frames @ turn.T, atol=1e-9)


def test_areas_add_up():
    points, faces = ball(0.5, (0, 0, 0), 60, 90)
    areas = vertex_areas(points, faces)
    assert areas.sum() == pytest.approx(4 * np.pi * 0.25, rel=2e-3)


def test_pixels_take_the_class_of_the_place_they_show():
    points, faces = ball(0.5, (0, 0, 0))
    classes = np.where(points[:, 1] > 0.05, MANY, UNSEEN).astype(np.int8)
    seen = view(points, 0.0)
    drawn = rasterize_mesh(seen.pixels, seen.depths, faces, SIZE, SIZE)
    mask = drawn.face >= 0
    mask[60:140, 130:160] = True  # cloth beyond the body
    mask[:, : SIZE // 2 - 30] = False
    picture = class_picture(classes, drawn, faces, mask)
    np.testing.assert_array_equal(picture >= 0, mask)
    for row, column in zip(*np.nonzero(mask & (drawn.face >= 0)), strict=True):
        corners = faces[drawn.face[row, column]]
        assert picture[row, column] == classes[corners[drawn.barycentrics[row, column].argmax()]]
    beyond = mask & (drawn.face < 0)
    body_rows, body_columns = np.nonzero(drawn.face >= 0)
    for row, column in list(zip(*np.nonzero(beyond), strict=True))[::97]:
        away = np.hypot(body_rows - row, body_columns - column)
        near = away <= 1.05 * away.min() + 1e-9  # the distance is a chamfer one
        assert picture[row, column] in {picture_at(classes, drawn, faces, r, c) for r, c in
                                        zip(body_rows[near], body_columns[near], strict=True)}  # fmt: skip
    empty = rasterize_mesh(seen.pixels + 1e4, seen.depths, faces, SIZE, SIZE)
    assert class_picture(classes, empty, faces, mask) is None


def picture_at(classes, drawn, faces, row, column):
    return classes[faces[drawn.face[row, column]][drawn.barycentrics[row, column].argmax()]]
