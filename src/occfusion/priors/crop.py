"""The square around the person in which a prior works."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

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
