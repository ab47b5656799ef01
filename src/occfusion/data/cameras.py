"""Cameras: from stored pictures to the size that is trained on, and one that is written anew for each frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.data.body_convention import carried
from occfusion.data.checking import checks
from occfusion.data.folder_contents import need
from occfusion.data.scene import Array, BodyParameters, Calibration
from occfusion.data.silhouette import Hidden, Silhouette
from occfusion.errors import DataError
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


SAME_PIXELS = 1e-2
"""Largest change, in pixels, of an intrinsic from frame to frame that is taken for lost digits."""

_STILL = 1e-6
"""Extrinsics this near to the first frame's are the same camera, written in float32."""


class FixedCamera:
    """A camera of one or of N frames, checked.

    Attributes:
        calibration: the camera of the first frame.
        zooms: K or the distortion is not the same in all frames; `at` gives each frame's.
        moves: the extrinsics are not the same in all frames; `carry` brings that into the body.
    """

    def __init__(
        self,
        name: str,
        intrinsics: Sequence[Any],
        extrinsics: Sequence[Any],
        distortions: Sequence[Any] | None,
        where: Sequence[str],
        centre_shift: float,
        *,
        may_zoom: bool = False,
    ) -> None:
        """Checks all frames.

        Args:
            name: what messages call the camera.
            intrinsics: K of each frame, `[3, 3]`.
            extrinsics: world to camera of each frame, `[4, 4]` or `[3, 4]`, metres.
            distortions: lens distortion of each frame; none when None.
            where: what messages call each frame.
            centre_shift: added to principal points: 0.5 where the file counts pixel centres from 0.
            may_zoom: K and distortion may change from frame to frame: the reader gives each frame's own.

        Raises:
            DataError: an entry cannot be, or K changes and may not; names the frame.
        """
        lenses = [_lens(K, D, at) for K, D, at in zip(
            intrinsics, distortions or [np.zeros(5)] * len(where), where, strict=True)]  # fmt: skip
        changed = next((k for k, lens in enumerate(lenses) if _differ(lens, lenses[0])), None)
        if changed is not None and not may_zoom:
            raise DataError(
                f"{where[changed]}: the intrinsics differ from those of the first frame; a lens that zooms, or "
                "pictures cropped one by one, are not supported. Undo the crop."
            )
        self.zooms = changed is not None
        views = [_extrinsics(value, at) for value, at in zip(extrinsics, where, strict=True)]
        checks.check_metres(np.stack([view[:3, 3] for view in views]), where[0])
        first = views[0]
        back = _inverse(first)
        self._motions = [None if np.abs(view - first).max() <= _STILL else back @ view for view in views]
        self.moves = any(motion is not None for motion in self._motions)
        shift = np.array([[0, 0, centre_shift], [0, 0, centre_shift], [0, 0, 0]])
        self._lenses = [(K + shift, bent) for K, bent in (lenses if self.zooms else lenses[:1])]
        self.calibration = Calibration(
            name, self._lenses[0][0], first[:3, :3], first[:3, 3], self._lenses[0][1]
        )

    @classmethod
    def of_rows(
        cls,
        name: str,
        rows: Sequence[Mapping[str, Any]],
        where: Sequence[str],
        keys: tuple[str, str],
        distortion: str | None = None,
        *,
        may_zoom: bool = False,
    ) -> FixedCamera:
        """Returns the camera of a table, whose principal points count as OpenCV does.

        Args:
            name: what messages call the camera.
            rows: of each frame.
            where: what messages call each frame.
            keys: of K and of the extrinsics in a row.
            distortion: key of the lens distortion, which not every row needs to have.
            may_zoom: K and distortion may change from frame to frame.

        Raises:
            DataError: as the class; or a key is missing.
        """
        intrinsics, extrinsics = (
            [need(row, key, at) for row, at in zip(rows, where, strict=True)] for key in keys
        )
        bent = [row.get(distortion, np.zeros(5)) for row in rows] if distortion else None
        return cls(name, intrinsics, extrinsics, bent, where, OPENCV_CENTRE, may_zoom=may_zoom)

    def at(self, frame: int) -> Calibration:
        """Returns the camera with the K and the distortion of a frame."""
        if not self.zooms:
            return self.calibration
        K, distortion = self._lenses[frame]
        return replace(self.calibration, K=K, distortion=distortion)

    def carry(self, frame: int, body: BodyParameters, pelvis: Array) -> BodyParameters:
        """Returns the body of a frame in the world of the first frame's camera.

        Args:
            frame: position of the frame.
            body: parameters in the frame's own world.
            pelvis: the pelvis at rest, `[3]`, metres.
        """
        motion = self._motions[frame]
        if motion is None:
            return body
        orient, transl = carried(body.global_orient, body.transl, motion, pelvis)
        return BodyParameters(body.betas, orient, body.body_pose, transl)


def _differ(lens: tuple[Array, Array], first: tuple[Array, Array]) -> bool:
    """Whether K or the distortion differ by more than lost digits."""
    return bool(np.abs(lens[0] - first[0]).max() > SAME_PIXELS) or not np.array_equal(lens[1], first[1])


def _lens(K: Any, distortion: Any, where: str) -> tuple[Array, Array]:
    matrix = checks.numbers(K, 9, f"{where}, intrinsics").reshape(3, 3)
    return matrix, checks.distortion(distortion, f"{where}, distortions")


def _extrinsics(value: Any, where: str) -> Array:
    label = f"{where}, extrinsics"
    given = checks.numbers(value, 16 if checks.count_of(value) == 16 else 12, label).reshape(-1, 4)
    if len(given) == 4 and not np.allclose(given[3], (0, 0, 0, 1), atol=1e-5):
        raise DataError(
            f"{label} has the last row {given[3].tolist()}, not 0 0 0 1: is the matrix transposed?"
        )
    view = np.eye(4)
    view[:3] = given[:3]
    view[:3, :3] = checks.rotation(view[:3, :3], f"{label}, its rotation")
    return view


def _inverse(view: Array) -> Array:
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = view[:3, :3].T, -view[:3, :3].T @ view[:3, 3]
    return back
