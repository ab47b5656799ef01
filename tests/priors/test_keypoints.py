"""Key points, and the z-buffer test of joints on scenes made by hand."""

import numpy as np
import pytest
import torch

from occfusion.geometry.camera import project_vertices
from occfusion.human.body import embedded_body
from occfusion.observation.bodyview import view_body
from occfusion.observation.keypoints import (
    LIMBS,
    MIRRORED,
    NAMES,
    NUM_KEYPOINTS,
    face_vertices,
    keypoints_3d,
    see_keypoints,
)
from occfusion.priors.embedded.conditions import limb_maps
from occfusion.types import Camera

SIZE = 64


def camera() -> Camera:
    viewmat = torch.eye(4)
    K = torch.tensor([[SIZE, 0.0, SIZE / 2], [0.0, SIZE, SIZE / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat, K, SIZE, SIZE)


def wall(depth: float) -> np.ndarray:
    """A z-buffer with a wall on the left half of the picture, nothing on the right."""
    surface = np.full((SIZE, SIZE), np.inf, np.float32)
    surface[:, : SIZE // 2] = depth
    return surface


@pytest.mark.parametrize(("behind", "shown"), [(0.0, True), (0.29, True), (0.31, False), (2.0, False)])
def test_joint_is_dropped_when_farther_behind_the_surface_than_sigma(behind: float, shown: bool) -> None:
    points = torch.zeros(NUM_KEYPOINTS, 3)
    points[:, 0], points[:, 2] = -0.2, 2.0 + behind
    seen = see_keypoints(points, camera(), wall(2.0))
    assert bool(seen.shown.all()) is shown
    points[:, 0] = 0.2  # beside the wall nothing hides them
    assert see_keypoints(points, camera(), wall(2.0)).shown.all()


def test_sigma_is_in_metres_and_infinite_keeps_all() -> None:
    points = torch.zeros(NUM_KEYPOINTS, 3)
    points[:, 0], points[:, 2] = -0.2, 2.5
    assert not see_keypoints(points, camera(), wall(2.0), sigma=0.4).shown.any()
    assert see_keypoints(points, camera(), wall(2.0), sigma=0.6).shown.all()
    assert see_keypoints(points, camera(), wall(2.0), sigma=np.inf).shown.all()


def test_points_behind_the_camera_or_outside_are_no_trouble() -> None:
    points = torch.zeros(NUM_KEYPOINTS, 3)
    points[:, 2] = -1.0
    points[0] = torch.tensor([50.0, 0.0, 1.0])
    seen = see_keypoints(points, camera(), wall(2.0))
    assert not seen.shown[1:].any()
    assert np.isfinite(seen.pixels).all()


def test_a_hand_behind_the_back_is_dropped_for_the_camera_in_front() -> None:
    body = embedded_body()
    pose = torch.zeros(69)
    vertices, joints = body(torch.zeros(10), torch.zeros(3), pose, torch.zeros(3))
    points = keypoints_3d(vertices, joints, face_vertices(body))
    wrist = NAMES.index("r_wrist")
    points[wrist] = points[NAMES.index("neck")] + torch.tensor([0.0, -0.2, -0.6])
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))  # y up; looking at the body's face
    viewmat[:3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    viewmat[2, 3] = 3.0
    view = Camera(viewmat, camera().K, SIZE, SIZE)
    pixels, depths = project_vertices(
        vertices.double().numpy(), viewmat.double().numpy(), view.K.double().numpy()
    )
    surface = view_body(pixels, depths, body.faces.numpy(), SIZE, SIZE).depth
    seen = see_keypoints(points, view, surface)
    assert not seen.shown[wrist]
    assert seen.shown[NAMES.index("l_wrist")]
    assert seen.shown[NAMES.index("nose")]


def test_face_of_the_embedded_body_is_a_face() -> None:
    body = embedded_body()
    nose, r_eye, l_eye, r_ear, l_ear = body.v_template[list(face_vertices(body))]
    assert nose[2] > r_eye[2] > r_ear[2]
    assert nose[2] > l_eye[2] > l_ear[2]
    assert r_ear[0] < r_eye[0] < nose[0] < l_eye[0] < l_ear[0]
    assert abs(float(nose[0])) < 0.01
    assert float(r_eye[1]) > float(nose[1])


def test_mirroring_twice_changes_nothing_and_limbs_are_openposes() -> None:
    order = np.array(MIRRORED)
    assert (order[order] == np.arange(NUM_KEYPOINTS)).all()
    assert len(LIMBS) == 17
    for k, name in enumerate(NAMES):
        other = name.replace("l_", "?_").replace("r_", "l_").replace("?_", "r_")
        assert NAMES[order[k]] == other


def test_limb_maps_are_where_the_limbs_are() -> None:
    points = torch.full((1, NUM_KEYPOINTS, 2), 0.5)
    points[0, 2], points[0, 3], points[0, 4] = torch.tensor([[0.2, 0.2], [0.2, 0.5], [0.2, 0.8]])
    shown = torch.ones(1, NUM_KEYPOINTS, dtype=torch.bool)
    maps = limb_maps(points, shown, 32)
    right_arm = maps[0, 1]
    column = int(0.2 * 32)
    assert float(right_arm[12, column]) > 0.9
    assert float(right_arm[12, column + 10]) < 0.05
    shown[0, 3] = False  # without the elbow neither part of the arm is drawn
    assert float(limb_maps(points, shown, 32)[0, 1].max()) == 0.0


def test_limb_maps_have_the_gradient_of_their_distance() -> None:
    points = torch.rand(1, NUM_KEYPOINTS, 2, dtype=torch.float64, requires_grad=True)
    shown = torch.ones(1, NUM_KEYPOINTS, dtype=torch.bool)
    assert torch.autograd.gradcheck(lambda p: limb_maps(p, shown, 5), (points,), atol=1e-4)
