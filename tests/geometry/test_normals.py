"""Normals of vertices against spheres, and against sums over faces one at a time."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from occfusion.geometry.normals import vertex_normals


def test_normals_of_a_sphere_point_outwards() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    points = np.asarray(ball.vertices)
    moved = points + np.array([3.0, -2.0, 1.0])
    assert np.abs(vertex_normals(moved, ball.faces) - points).max() < 0.02


def test_normals_are_means_of_the_faces_around_by_area() -> None:
    generator = np.random.default_rng(0)
    points = generator.normal(size=(12, 3))
    faces = np.array([generator.choice(12, 3, replace=False) for _ in range(40)])
    expected = np.zeros((12, 3))
    for a, b, c in faces:
        for corner in (a, b, c):
            expected[corner] += np.cross(points[b] - points[a], points[c] - points[a])
    lengths = np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.allclose(vertex_normals(points, faces), expected / lengths, atol=1e-12)


def test_a_vertex_without_a_face_and_a_flat_face_have_no_normal() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]])
    assert np.array_equal(vertex_normals(points, np.array([[0, 1, 2]])), np.zeros((4, 3)))


def test_a_face_of_vertices_that_do_not_exist_is_refused() -> None:
    for wrong in (3, -1):
        with pytest.raises(IndexError, match="of 3"):
            vertex_normals(np.eye(3), np.array([[0, 1, wrong]]))
    assert vertex_normals(np.zeros((2, 3)), np.zeros((0, 3), int)).shape == (2, 3)
