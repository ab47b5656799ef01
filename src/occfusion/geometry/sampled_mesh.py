"""A triangle mesh in the picture, several samples a pixel: how much of each it covers, and with which face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.zbuffer import NO_FACE, nearest_faces
from occfusion.types import Box

SAMPLES = 2
"""A side, in each pixel."""


@dataclass(frozen=True)
class SampledMesh:
    """A window of a picture.

    Attributes:
        samples: the face that each sample sees first, -1 where there is none, `[SAMPLES h, SAMPLES w]`.
        depths: of what it sees, metres; infinite where there is nothing.
    """

    samples: NDArray[np.int32]
    depths: NDArray[np.float32]

    @classmethod
    def draw(
        cls,
        pixels: NDArray[np.floating],
        depths: NDArray[np.floating],
        faces: NDArray[np.integer],
        box: Box,
        *,
        closed: bool = False,
    ) -> SampledMesh:
        """Returns a mesh inside a box of a picture.

        Args:
            pixels: projected vertices, `[V, 2]`, pixels of the whole picture (centres at +0.5).
            depths: of the vertices, `[V]`, metres.
            faces: triangles, `[F, 3]`.
            box: of the window: left, top, width, height.
            closed: as in `nearest_faces`.
        """
        x, y, width, height = box
        moved = SAMPLES * (pixels - np.array([x, y], dtype=np.float64))
        seen = nearest_faces(moved, depths, faces, SAMPLES * width, SAMPLES * height, closed=closed)
        return cls(seen.face, seen.depth)

    @property
    def coverage(self) -> NDArray[np.float32]:
        """Share of each pixel that is covered, `[h, w]`, 0..1."""
        hits = (self.samples != NO_FACE).view(np.uint8)
        total = sum(hits[y::SAMPLES, x::SAMPLES] for y in range(SAMPLES) for x in range(SAMPLES))
        return np.asarray(total, np.float32) / np.float32(SAMPLES**2)

    @property
    def nearest(self) -> NDArray[np.float32]:
        """Depth of the nearest sample of each pixel, `[h, w]`, metres; infinite where there is nothing."""
        rows = np.minimum.reduce([self.depths[y::SAMPLES] for y in range(SAMPLES)])
        return np.minimum.reduce([rows[:, x::SAMPLES] for x in range(SAMPLES)])

    def face_at(self, pixels: NDArray[np.integer]) -> NDArray[np.int32]:
        """Returns a face that covers each of some pixels, the last in the list of faces; -1 where none does.

        Args:
            pixels: row and column in the window, `[N, 2]`.
        """
        row, column = SAMPLES * np.asarray(pixels).T
        each = [self.samples[row + y, column + x] for y in range(SAMPLES) for x in range(SAMPLES)]
        return np.asarray(np.max(each, axis=0), np.int32)


def box_of(pixels: NDArray[np.floating], width: int, height: int) -> Box:
    """Returns the part of a picture about projected points, one pixel at least; those that are not finite do not count.

    Args:
        pixels: `[V, 2]`.
        width: of the picture.
        height: of the picture.
    """
    finite = pixels
    if not np.isfinite(pixels).all():
        finite = pixels[np.isfinite(pixels).all(axis=1)]
    if not len(finite):
        return 0, 0, 1, 1
    columns = np.ascontiguousarray(finite.T)  # NumPy takes the least of short rows one by one
    least, most = (np.clip(end, 0.0, [width, height]) for end in (columns.min(axis=1), columns.max(axis=1)))
    low = np.minimum(np.floor(least), [width - 1, height - 1]).astype(int)
    high = np.maximum(np.ceil(most).astype(int), low + 1)
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])
