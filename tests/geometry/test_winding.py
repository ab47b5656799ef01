"""Whether a surface is closed, and what lies within one."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from occfusion.geometry.winding import is_closed, winding_number


def ball() -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    return np.asarray(mesh.vertices) + np.array([3.0, -1.0, 2.0]), np.asarray(mesh.faces)


def test_a_closed_surface_has_each_edge_both_ways_and_faces_outwards() -> None:
    points, faces = ball()
    assert is_closed(points, faces)
    assert is_closed(np.concatenate([points, points + 5]), np.concatenate([faces, faces + len(points)]))
    ring = trimesh.creation.torus(1.0, 0.3)
    assert is_closed(np.asarray(ring.vertices), np.asarray(ring.faces))
    assert not is_closed(points, faces[1:])  # a hole
    assert not is_closed(points, faces[:, ::-1])  # inside out
    turned = faces.copy()
    turned[0] = turned[0, ::-1]
    assert not is_closed(points, turned)
    assert not is_closed(points, np.concatenate([faces, faces[:1]]))  # a triangle twice
    assert not is_closed(points, faces[:0])


@pytest.mark.parametrize(("where", "times"), [((3.1, -1.2, 2.3), 1.0), ((0.0, 0.0, 0.0), 0.0)])
def test_a_closed_surface_goes_round_what_is_within_it_once(where, times) -> None:
    assert winding_number(np.array(where), *ball()) == pytest.approx(times, abs=1e-9)
