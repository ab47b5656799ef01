"""The region of interest in which pictures are inpainted: the body's box with a margin (paper §4.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.geometry.camera import project_vertices
from occfusion.observation.bodyview import view_body
from occfusion.observation.frames import Observation
from occfusion.observation.keypoints import Keypoints, see_keypoints
from occfusion.types import Camera

MULTIPLE = 8
"""Pixels of the picture for each of the latent, a side: width and height must be multiples of it."""


@dataclass(frozen=True)
class Region:
    """A window of a picture and the size at which it is worked on; it may reach beyond the picture.

    Attributes:
        x: first column.
        y: first row.
        width: columns, a multiple of 8.
        height: rows, a multiple of 8.
        work_width: columns at work, a multiple of 8.
        work_height: rows at work, a multiple of 8.
    """

    x: int
    y: int
    width: int
    height: int
    work_width: int
    work_height: int

    @classmethod
    def around(
        cls, points: NDArray[np.floating], picture: tuple[int, int], margin: int, resolution: int = 0
    ) -> Region | None:
        """Returns the region around the part of the body inside a picture; None where no part is inside.

        Args:
            points: projected vertices `[V, 2]`, pixels; those in front of the camera.
            picture: its width and height.
            margin: pixels on each side; at the picture's border it ends there.
            resolution: longer side at work, pixels, a multiple of 8; 0: the region's own size.
        """
        limit = np.array(picture)
        if len(points) == 0:
            return None
        low, high = np.floor(points.min(axis=0)), np.ceil(points.max(axis=0))
        if (high <= 0).any() or (low >= limit).any():
            return None
        low, high = np.clip(low - margin, 0, limit), np.clip(high + margin, 0, limit)
        size = _rounded_up(high - low)
        # the pixels that rounding added are shared out, inside the picture where it has room
        start = np.clip(low - (size - (high - low)) // 2, 0, np.maximum(limit - size, 0)).astype(int)
        return cls(*(int(value) for value in (*start, *size, *size))).at_work(resolution)

    def at_work(self, resolution: int, copies: int = 1) -> Region:
        """Returns the region worked on at another size.

        Args:
            resolution: longer side of what is worked on, pixels, a multiple of 8 times `copies`; 0: the region's
                own size.
            copies: regions of this size that stand side by side in it.
        """
        work = size = np.array([self.width, self.height])
        if resolution:
            scaled = size * (resolution / max(copies * self.width, self.height))
            work = np.maximum(MULTIPLE * np.rint(scaled / MULTIPLE).astype(int), MULTIPLE)
        return replace(self, work_width=int(work[0]), work_height=int(work[1]))

    @property
    def scale(self) -> tuple[float, float]:
        """Returns pixels at work for each of the picture, in x and y."""
        return self.work_width / self.width, self.work_height / self.height

    def camera(self, camera: Camera) -> Camera:
        """Returns the camera whose picture is this region at work."""
        K = camera.K.clone()
        K[0, 2] -= self.x
        K[1, 2] -= self.y
        scale = torch.diag(K.new_tensor([*self.scale, 1.0]))
        return Camera(camera.viewmat, scale @ K, self.work_width, self.work_height)

    def take(self, picture: NDArray[np.float32], outside: float) -> NDArray[np.float32]:
        """Returns the region of a picture `[H, W]` or `[H, W, C]` at work; `outside` is the value beyond it."""
        height, width = picture.shape[:2]
        window = np.full((self.height, self.width, *picture.shape[2:]), outside, np.float32)
        inside = picture[self.y : min(self.y + self.height, height), self.x : min(self.x + self.width, width)]
        window[: inside.shape[0], : inside.shape[1]] = inside
        return _resized(window, self.work_width, self.work_height)

    def put(self, window: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
        """Returns a picture `[H, W]` or `[H, W, C]` with a window at work in its place; 0 around it.

        Args:
            window: `[work_height, work_width]` or `[work_height, work_width, C]`.
            width: columns of the picture.
            height: rows of the picture.
        """
        own = _resized(window, self.width, self.height)
        picture = np.zeros((height, width, *window.shape[2:]), np.float32)
        rows, columns = min(self.height, height - self.y), min(self.width, width - self.x)
        picture[self.y : self.y + rows, self.x : self.x + columns] = own[:rows, :columns]
        return picture

    def inside(self, width: int, height: int) -> NDArray[np.bool_]:
        """Returns which pixels of a picture lie in the region, bool `[height, width]`."""
        found = np.zeros((height, width), np.bool_)
        found[self.y : self.y + self.height, self.x : self.x + self.width] = True
        return found


def _rounded_up(size: NDArray[np.floating]) -> NDArray[np.int64]:
    rounded: NDArray[np.int64] = (MULTIPLE * np.maximum(np.ceil(size / MULTIPLE), 1)).astype(np.int64)
    return rounded


def _resized(picture: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Returns a picture at another size: averaged over areas where it shrinks, bilinear where it grows."""
    if picture.shape[:2] == (height, width):
        return picture
    shrinks = picture.shape[0] * picture.shape[1] > width * height
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, (width, height), interpolation=how), np.float32)


def body_region(observation: Observation, margin: int, resolution: int = 0) -> Region | None:
    """Returns the region around a frame's body; None where the body is outside the picture.

    Args:
        observation: the frame.
        margin: pixels around the body's box.
        resolution: longer side at work, pixels; 0: the region's own size.
    """
    camera = observation.camera
    pixels, depths = project_vertices(
        observation.vertices, camera.viewmat.double().numpy(), camera.K.double().numpy()
    )
    height, width = observation.visible.shape
    return Region.around(pixels[depths > 0.01], (width, height), margin, resolution)


def body_keypoints(observation: Observation, region: Region, sigma: float) -> Keypoints:
    """Returns the key points in a region at work, without those that the body itself hides.

    Args:
        observation: the frame.
        region: in whose pixels, at work, the key points are given.
        sigma: how far behind the body's surface a point may lie, metres.
    """
    camera = region.camera(observation.camera)
    projected = project_vertices(
        observation.vertices, camera.viewmat.double().numpy(), camera.K.double().numpy()
    )
    depth = view_body(*projected, observation.faces, camera.width, camera.height).depth
    return see_keypoints(torch.from_numpy(observation.keypoints), camera, depth, sigma)
