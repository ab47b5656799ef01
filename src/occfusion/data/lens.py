"""From stored pictures to the size that is trained on: lens distortion removed, then scaled by area."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.data.scene import Calibration
from occfusion.data.silhouette import Hidden, Silhouette
from occfusion.types import Camera

OPENCV_CENTRE = 0.5
"""OpenCV counts the middle of the first pixel as 0, this package as 0.5; principal points differ by this."""

_MAJORITY = 128
"""A pixel belongs to the person when at least half of its area does."""

_NO_DISTORTION = 1e-12


@dataclass(frozen=True)
class Lens:
    """How the stored pictures of one camera become frames.

    Attributes:
        calibration: the camera at the stored size.
        source: (width, height) of the stored pictures.
        size: (width, height) of the frames.
    """

    calibration: Calibration
    source: tuple[int, int]
    size: tuple[int, int]

    @classmethod
    def fitted(cls, calibration: Calibration, source: tuple[int, int], image_size: int) -> Lens:
        """Returns the lens whose frames have `image_size` as longer side; pictures are never enlarged."""
        scale = min(image_size / max(source), 1.0)
        return cls(calibration, source, (max(round(source[0] * scale), 1), max(round(source[1] * scale), 1)))

    def camera(self) -> Camera:
        """Returns the pinhole camera of the frames; K is scaled exactly with the pixels."""
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = self.calibration.R, self.calibration.t
        stored = Camera(
            torch.tensor(viewmat, dtype=torch.float32),
            torch.tensor(self.calibration.K, dtype=torch.float64),
            *self.source,
        )
        camera = stored.resized(*self.size)
        return Camera(camera.viewmat, camera.K.to(torch.float32), camera.width, camera.height)

    def picture(self, stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Returns a picture `[h, w, 3]` or a coverage `[h, w]` (0..255) without distortion, at frame size."""
        image: Any = stored
        if self._maps is not None:
            image = cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        if self.size != self.source:
            image = cv2.resize(image, self.size, interpolation=cv2.INTER_AREA)
        return np.asarray(image)

    def mask(self, stored: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Returns a mask at frame size: pixels of which at least half is covered."""
        return self.picture(stored.astype(np.uint8) * np.uint8(255)) >= _MAJORITY

    def hidden(self, region: Hidden) -> NDArray[np.bool_]:
        """Returns what is hidden at frame size: every pixel that it touches, so that nothing leaks."""
        if isinstance(region, Silhouette):
            return self.picture(region.full().astype(np.uint8) * np.uint8(255)) > 0
        stored = np.zeros(self.source[::-1], dtype=np.uint8)
        x, y, w, h = region
        stored[y : y + h, x : x + w] = 255
        return self.picture(stored) > 0

    @cached_property
    def _maps(self) -> tuple[Any, Any] | None:
        """Where each undistorted pixel lies in the stored picture; K stays the same (6 bytes a pixel)."""
        if np.abs(self.calibration.distortion).max(initial=0.0) < _NO_DISTORTION:
            return None
        K = self.calibration.K.copy()
        K[:2, 2] -= OPENCV_CENTRE
        maps = cv2.initUndistortRectifyMap(
            K, self.calibration.distortion, np.eye(3), K, self.source, cv2.CV_16SC2
        )
        return maps[0], maps[1]
