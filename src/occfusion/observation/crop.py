"""The square around the person in which a prior works, and what is known of the person in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.geometry.camera import orbit_camera, project_vertices
from occfusion.human.body import Body
from occfusion.observation.bodyview import BodyView, view_body
from occfusion.observation.frames import Observation
from occfusion.observation.keypoints import Keypoints, face_vertices, keypoints_3d, see_keypoints
from occfusion.types import Camera

PADDING = 0.10
"""Of the longer side of the body's projection, on each side: room for clothes and hair."""


@dataclass(frozen=True)
class Square:
    """A square window of a picture, in pixels; it may reach beyond the picture.

    Attributes:
        x: left edge.
        y: upper edge.
        side: width and height.
    """

    x: float
    y: float
    side: float

    @classmethod
    def around(cls, points: NDArray[np.floating], padding: float = PADDING) -> Square:
        """Returns the square about points `[N, 2]`, centred, padded by a share of the longer side.

        Raises:
            ValueError: no point, or one that is not finite.
        """
        if len(points) == 0 or not np.isfinite(points).all():
            raise ValueError("a square needs at least one point, all finite")
        low, high = points.min(axis=0), points.max(axis=0)
        side = float(max((high - low).max(), 1.0) * (1.0 + 2.0 * padding))
        centre = 0.5 * (low + high)
        return cls(float(centre[0] - 0.5 * side), float(centre[1] - 0.5 * side), side)

    def camera(self, camera: Camera, size: int) -> Camera:
        """Returns the camera whose picture of `size` x `size` pixels is this window."""
        scale = size / self.side
        K = camera.K.clone()
        K[0, 2] -= self.x
        K[1, 2] -= self.y
        return Camera(camera.viewmat, torch.diag(K.new_tensor([scale, scale, 1.0])) @ K, size, size)

    def take(self, picture: NDArray[np.float32], size: int, outside: float = 0.0) -> NDArray[np.float32]:
        """Returns the window of a picture `[H, W]` at `size` x `size`, averaged over each new pixel's area.

        Args:
            picture: any values.
            size: pixels a side.
            outside: value beyond the picture.
        """
        # a box of whole samples a pixel, then their mean: exact areas where a pixel covers many
        over = max(1, int(np.ceil(self.side / size)))
        scale = self.side / (size * over)
        grid = np.array([[scale, 0.0, self.x + 0.5 * scale - 0.5], [0.0, scale, self.y + 0.5 * scale - 0.5]])
        large = cv2.warpAffine(
            picture.astype(np.float32), grid, (size * over, size * over),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_CONSTANT, borderValue=outside,
        )  # fmt: skip
        return np.asarray(large.reshape(size, over, size, over).mean(axis=(1, 3)), np.float32)

    def put(
        self, window: NDArray[np.float32], height: int, width: int, outside: float
    ) -> NDArray[np.float32]:
        """Returns a picture `[H, W]` with the window `[S, S]` in its place, cubic, and `outside` around it."""
        size = window.shape[0]
        scale = size / self.side
        grid = np.array(
            [[scale, 0.0, (0.5 - self.x) * scale - 0.5], [0.0, scale, (0.5 - self.y) * scale - 0.5]]
        )
        return np.asarray(
            cv2.warpAffine(
                window, grid, (width, height), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_CONSTANT, borderValue=outside,
            ),
            np.float32,
        )  # fmt: skip


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
