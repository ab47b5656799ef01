"""Pictures of the dressed body from sides that nobody filmed: of a ball, whose outline is known, and of a person."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from occfusion.geometry.camera import camera_round, look_at
from occfusion.geometry.coverage import Sighting, cover, surface_frames
from occfusion.human.body import Body
from occfusion.human.observability import Observability, observe_surface
from occfusion.human.virtual_views import LARGEST, REACH, VirtualView, VirtualViews, virtual_view
from occfusion.types import Camera, Pose

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
FACES = np.asarray(BALL.faces, np.int64)
POINTS = np.asarray(BALL.vertices, np.float64)
CLOTHES = 0.02
STANDING = Pose(torch.zeros(10), torch.zeros(3), torch.zeros(69), torch.zeros(3), 0)
UP = torch.tensor([0.0, 1.0, 0.0])


def camera_before(distance: float = 3.0, focal: float = 300.0) -> Camera:
    """Straight before the origin, at the side of +z."""
    K = torch.tensor([[focal, 0.0, 80.0], [0.0, focal, 80.0], [0.0, 0.0, 1.0]])
    return Camera(look_at(distance * torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3), UP), K, 160, 160)


@pytest.fixture(scope="module")
def from_front() -> Observability:
    camera = camera_before()
    viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    coverage = cover(
        (Sighting.through(POINTS, viewmat, K, np.ones((160, 160), bool)) for _ in range(10)), FACES
    )
    assert coverage is not None
    return observe_surface(coverage, POINTS, FACES)


def seen_at(known: Observability, angle: float, turn: NDArray[np.float64] | None = None) -> VirtualView:
    """The ball from an angle; `turn` turns the posed ball and the camera, but not the canonical ball."""
    camera = camera_round(camera_before(), torch.zeros(3), UP, angle)
    if turn is not None:
        moved = torch.eye(4, dtype=torch.float64)
        moved[:3, :3] = torch.from_numpy(turn.T)
        camera = Camera(camera.viewmat.double() @ moved, camera.K, camera.width, camera.height)
    posed = POINTS if turn is None else POINTS @ turn.T
    return virtual_view(
        posed, surface_frames(POINTS, FACES), FACES, known, np.full(len(POINTS), CLOTHES), camera, STANDING
    )


def from_middle(view: VirtualView) -> NDArray[np.float64]:
    """Pixels from the middle of the ball to each pixel's middle, `[H, W]`."""
    rows, columns = np.mgrid[: view.camera.height, : view.camera.width] + 0.5
    return np.hypot(columns - float(view.camera.K[0, 2]), rows - float(view.camera.K[1, 2]))


@pytest.mark.parametrize("angle", [0.0, 1.1, math.pi / 2, 4.0])
def test_a_view_shows_the_dressed_body_where_it_is(from_front, angle):
    view = seen_at(from_front, angle)
    # a ball three metres off covers a disc of this radius
    focal = float(view.camera.K[0, 0])
    radius = focal * (0.3 + CLOTHES) / math.sqrt(9.0 - (0.3 + CLOTHES) ** 2)
    alpha, away = view.alpha.numpy() / 255.0, from_middle(view)
    assert (alpha[away < radius - 1.0] == 1.0).all() and (alpha[away > radius + 1.0] == 0.0).all()
    # the ball is a mesh of flat triangles, by which it is smaller
    assert alpha.sum() == pytest.approx(math.pi * radius**2, rel=0.01)
    # an edge between two pixels is grey, by how far it lies in the pixel
    rim = np.abs(away - radius) < 0.4
    assert np.abs(alpha - (radius - away + 0.5))[rim].max() < 0.4
    assert abs(float((alpha - (radius - away + 0.5))[rim].mean())) < 0.12 and np.unique(alpha[rim]).size == 5
    # the picture is cut to the ball and what is near it
    assert view.camera.width == pytest.approx(2 * (radius + REACH * focal / 3.0), abs=3)
    assert alpha.shape == (view.camera.height, view.camera.width)


def test_outlines_count_only_where_the_video_leaves_them_open(from_front):
    beside, behind = seen_at(from_front, math.pi / 2), seen_at(from_front, math.pi)
    middle = beside.camera.height // 2
    row, covered = beside.weight[middle].numpy() / 255.0, beside.alpha[middle].numpy() > 0
    assert row[covered].max() > 0.95  # from the side a front seen from before alone is open
    # from behind, the rim is the one that the front camera saw; so is all that is nearest to it outside
    rim = behind.weight[middle].numpy() / 255.0
    columns = np.flatnonzero(behind.alpha[middle].numpy())
    assert rim[columns[[2, -3]]].max() < 0.3
    assert rim[: columns[0]].max() < 0.3


def test_the_unseen_side_is_asked_from_behind_alone(from_front):
    front, behind = seen_at(from_front, 0.0), seen_at(from_front, math.pi)
    middle = front.camera.height // 2
    assert front.unseen[middle, middle] < 26 and behind.unseen[middle, middle] == 255
    assert front.unseen[0, 0] == 0
    nearest, farthest = (int((POINTS @ [0.0, 0.0, side]).argmax()) for side in (1.0, -1.0))
    assert front.is_away[farthest] and not front.is_away[nearest]
    assert behind.is_away[nearest] and not behind.is_away[farthest]


def test_what_is_known_turns_with_the_body(from_front):
    """The posed ball and the camera turned alike: the picture and all that is said of it stay."""
    turn = Rotation.from_rotvec([0.9, -0.4, 1.7]).as_matrix()
    still, turned = seen_at(from_front, 1.0), seen_at(from_front, 1.0, turn)
    for name in ("alpha", "weight", "unseen"):
        a, b = getattr(still, name).double(), getattr(turned, name).double()
        assert a.shape == b.shape and float((a - b).abs().mean()) < 0.2, name  # of 255: sums round otherwise
    assert torch.equal(still.is_away, turned.is_away)


def all_open(body: Body) -> tuple[Observability, NDArray[np.float64]]:
    """What a video says of a body of which it says nothing; and clothes of no thickness."""
    count = body.num_vertices
    known = Observability(
        np.tile(np.eye(3) / 3, (count, 1, 1)), np.tile(np.eye(3) / 3, (count, 1, 1)),
        np.tile([0.0, 0.0, 1.0], (count, 1)), np.ones(count), np.ones(count), np.zeros(count, bool),
    )  # fmt: skip
    return known, np.zeros(count)


def test_views_go_round_each_frames_own_body(free_body):
    """Bodies that stand elsewhere, and one that lies: each fills its picture, seen from another side."""
    lying = torch.tensor([math.pi / 2, 0.0, 0.0])
    turns = (torch.zeros(3), torch.zeros(3), torch.zeros(3), lying)
    poses = [
        Pose(torch.zeros(10), turn, torch.zeros(69), torch.tensor([0.3 * k, 0.0, 0.0]), k)
        for k, turn in enumerate(turns)
    ]
    frames = [(pose, camera_before(4.0)) for pose in poses]
    found = VirtualViews(len(frames), frames.__getitem__, free_body, *all_open(free_body))
    assert [view.pose.frame_index for view in found] == [0, 1, 2, 3]
    heights = []
    for view in found:
        rows, columns = (np.flatnonzero(view.alpha.numpy().any(axis=k)) for k in (1, 0))
        rim = REACH * 300.0 / 4.0
        for place, size in ((rows, view.camera.height), (columns, view.camera.width)):
            assert rim - 1 <= place[0] <= rim + 2 and rim - 1 <= size - 1 - place[-1] <= rim + 2
        heights.append(len(rows))
    assert max(heights) < 1.08 * min(heights)  # upright in the picture, also who lies
    sides = [view.camera.viewmat[2, :3].double().numpy() for view in found[:3]]
    assert all(math.degrees(math.acos(a @ b)) > 60 for a, b in pairwise(sides))


@pytest.mark.parametrize(("distance", "focal"), [(0.4, 300.0), (0.9, 4000.0), (60.0, 9000.0)])
def test_close_ups_and_large_pictures_stay_small(free_body, distance, focal):
    """A camera that an arm reaches, one whose picture shows a hand alone, and one far away."""
    frame = (STANDING, camera_before(distance, focal))
    for view in VirtualViews(5, lambda number: frame, free_body, *all_open(free_body)):
        assert max(view.camera.width, view.camera.height) <= LARGEST + 2
        shown = view.alpha.numpy() > 127
        assert 0.05 < shown.mean() < 0.8
        assert not (shown[0].any() or shown[-1].any() or shown[:, 0].any() or shown[:, -1].any())


def test_views_are_drawn_once_and_only_when_asked_for(free_body):
    asked = []

    def frame(number: int) -> tuple[Pose, Camera]:
        asked.append(number)
        return STANDING, camera_before()

    views = VirtualViews(8, frame, free_body, *all_open(free_body))
    assert len(views) == 8 and asked == []
    assert views[5] is views[5] and views[-1] is views[7] and asked == [5, 7]
    assert views[4:6][1] is views[5] and asked == [5, 7, 4]
    with pytest.raises(IndexError):
        views[8]
