"""What a prior can be told of a person in a square crop: the body there, and what is known of the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.geometry.camera import orbit_camera, project_vertices
from occfusion.human.body import Body
from occfusion.priors.bodyview import BodyView, view_body
from occfusion.priors.crop import Square
from occfusion.priors.keypoints import Keypoints, face_vertices, keypoints_3d, see_keypoints
from occfusion.priors.masks import Observation
from occfusion.types import Camera

Plane = NDArray[np.float32]

CANONICAL_ANGLES = 18
"""Directions from which the canonical pose is seen: multiples of 20 degrees (paper §4.2)."""
CANONICAL_DISTANCE = 4.5
"""Metres from the camera to the middle of the body in the canonical pose."""
_ANY_VIEW, _ANY_SIZE = math.radians(30.0), 1000  # the crop decides what is seen


@dataclass(frozen=True)
class PersonView:
    """A body in a square crop.

    Attributes:
        camera: whose picture is the crop, S x S pixels.
        vertices: the body mesh in the world, `[V, 3]`, metres.
        keypoints: its key points, `[18, 3]`, metres.
        faces: its triangles, `[F, 3]`.
        visible: pixels that show the person, `[S, S]`, 0 or 1; None where nothing is known.
        background: pixels known to be background, `[S, S]`, 0 or 1; None where nothing is known.
    """

    camera: Camera
    vertices: NDArray[np.float64]
    keypoints: NDArray[np.float64]
    faces: NDArray[np.int64]
    visible: Plane | None
    background: Plane | None

    @property
    def size(self) -> int:
        """Pixels a side."""
        return self.camera.width

    @property
    def hidden(self) -> Plane:
        """Pixels that are neither seen to show the person nor known background, `[S, S]`, 0 or 1."""
        if self.visible is None or self.background is None:
            return np.ones((self.size, self.size), np.float32)
        return ((self.visible < 0.5) & (self.background < 0.5)).astype(np.float32)

    def body(self) -> BodyView:
        """Returns the body mesh as the camera sees it."""
        viewmat, K = self.camera.viewmat.double().numpy(), self.camera.K.double().numpy()
        return view_body(*project_vertices(self.vertices, viewmat, K), self.faces, self.size, self.size)

    def seen(self, body: BodyView) -> Keypoints:
        """Returns the key points in the crop, without those that the body itself hides."""
        return see_keypoints(torch.from_numpy(self.keypoints), self.camera, body.depth)


def view_observation(observation: Observation, size: int) -> tuple[Square, PersonView]:
    """Returns the square around the body in a frame, and the view of it at `size` x `size` pixels."""
    camera = observation.camera
    viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    pixels, depths = project_vertices(observation.vertices, viewmat, K)
    square = Square.around(pixels[depths > 0.01])
    visible = square.take(observation.visible.astype(np.float32), size)
    background = square.take(observation.background.astype(np.float32), size, outside=1.0)
    view = PersonView(
        square.camera(camera, size), observation.vertices, observation.keypoints, observation.faces,
        (visible > 0.5).astype(np.float32), (background > 0.5).astype(np.float32),
    )  # fmt: skip
    return square, view


@torch.no_grad()
def view_canonical(body: Body, turn: int, size: int) -> PersonView:
    """Returns the body of mean shape in the Da pose, seen from one of `CANONICAL_ANGLES` sides, nothing else known.

    Args:
        body: the body.
        turn: multiple of 20 degrees by which the camera goes round it, counter-clockwise seen from above; 0: front.
        size: pixels a side.
    """
    pose = body.da_pose()
    vertices, joints = body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)
    vertices, joints = vertices.double().cpu(), joints.double().cpu()
    middle = 0.5 * (vertices.amin(dim=0) + vertices.amax(dim=0))
    angle = 2.0 * math.pi * turn / CANONICAL_ANGLES
    camera = orbit_camera(middle, angle, CANONICAL_DISTANCE, _ANY_VIEW, _ANY_SIZE)
    pixels, _ = project_vertices(vertices.numpy(), camera.viewmat.numpy(), camera.K.numpy())
    keypoints = keypoints_3d(vertices, joints, face_vertices(body)).numpy()
    window = Square.around(pixels).camera(camera, size)
    return PersonView(window, vertices.numpy(), keypoints, body.faces.cpu().numpy(), None, None)
