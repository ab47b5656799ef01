"""Points of the body as frames show them: what light and exposure are told by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.normals import vertex_normals
from occfusion.observation.bodyview import view_body
from occfusion.observation.evidence import person_size
from occfusion.observation.frames import ObservedFrame
from occfusion.types import Frame

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

FACING = 0.2
"""Cosine between normal and line of sight: points seen more from the side show their neighbours as well."""
BEHIND = 0.02
"""Metres behind the surface that a camera sees first from which on a point counts as hidden by the body itself."""
RIM = 0.01
"""Of the person's size: pixels nearer to what is not the person are left out."""
SIGHTINGS = 5
"""Fewer than this of a point tell its own colour and nothing else."""
POINTS = 200
"""Fewer seen that often tell nothing of light."""
PATCH = 64
"""Vertices whose numbers follow each other lie beside each other; so many share their errors."""
CUT = 2.0
"""Median differences from which on an observation counts little: another garment, a seam, a wrong pose."""


@dataclass(frozen=True)
class Sightings:
    """Points of the body as frames show them, a row each.

    Attributes:
        points: vertex numbers, `[M]`.
        colors: `[M, 3]`, 0..1.
        normals: of the body's surface in the world, unit, `[M, 3]`.
        frames: positions of the frames that show them, `[M]`.
    """

    points: Integers
    colors: Floats
    normals: Floats
    frames: Integers

    def of(self, rows: NDArray[np.bool_]) -> Sightings:
        """Returns some of them, of points that these still tell of."""
        return join([Sightings(self.points[rows], self.colors[rows], self.normals[rows], self.frames[rows])])

    def halves(self) -> tuple[Sightings, Sightings]:
        """Returns those of every other patch of the body, and of the patches between.

        What is wrong with a garment, an edge or a limb is in one of them.
        """
        is_second = self.points // PATCH % 2 == 1
        return self.of(~is_second), self.of(is_second)

    def thinned(self, most: int) -> Sightings:
        """Returns those of some points, evenly spread: about `most`, or those of as many points as tell by halves."""
        few = len(np.unique(self.points)) // (4 * POINTS)
        every = max(1, min(-(-len(self.points) // most), few))
        return self.of(self.points % every == 0)

    def numbered(self) -> tuple[Integers, int] | None:
        """Returns each row's point counted from 0, and how many there are; None where these tell nothing."""
        points = np.unique(self.points, return_inverse=True)[1]
        count = int(points.max()) + 1 if len(points) else 0
        return (points, count) if count >= POINTS else None


def sight_frames(
    positions: Sequence[int],
    read: Callable[[int], Frame],
    observed_frames: Sequence[ObservedFrame],
    faces: NDArray[np.integer],
) -> list[Sightings]:
    """Returns what some frames show.

    Args:
        positions: of these frames.
        read: gives the training frame at a position, without truth.
        observed_frames: what is known of each.
        faces: of the body mesh, `[F, 3]`.
    """
    return [sight(k, read(k), observed_frames[k], faces) for k in positions]


def sight(
    position: int, frame: Frame, observed_frame: ObservedFrame, faces: NDArray[np.integer]
) -> Sightings:
    """Returns the points of the body that a frame shows well."""
    visible = frame.visible_mask.cpu().numpy()
    height, width = visible.shape
    rim = max(1, round(RIM * person_size(visible)))
    inside = cv2.erode(visible.astype(np.uint8), np.ones((2 * rim + 1, 2 * rim + 1), np.uint8)) > 0
    posed = observed_frame.posed()
    pixels, depths = posed.projected.pixels, posed.projected.depths
    surface = view_body(pixels, depths, faces, width, height).depth
    normals = vertex_normals(posed.vertices, faces)
    viewmat = frame.camera.viewmat.double().cpu().numpy()
    towards = -viewmat[:3, :3].T @ viewmat[:3, 3] - posed.vertices
    cosine = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    is_in = ((pixels >= 0) & (pixels < (width, height))).all(axis=1) & (cosine > FACING)
    points = np.flatnonzero(is_in)
    columns, rows = pixels[points].astype(int).T
    is_shown = inside[rows, columns] & (depths[points] < surface[rows, columns] + BEHIND)
    points, rows, columns = points[is_shown], rows[is_shown], columns[is_shown]
    smooth = cv2.blur(frame.rgb.cpu().numpy().astype(np.float32), (3, 3))
    colors = smooth[rows, columns].astype(np.float64)
    return Sightings(points, colors, normals[points], np.full(len(points), position))


def join(parts: Sequence[Sightings]) -> Sightings:
    """Returns the sightings of points that are seen often enough to tell how they change."""
    points = np.concatenate([part.points for part in parts])
    often = np.bincount(points, minlength=1)[points] >= SIGHTINGS
    return Sightings(
        points[often],
        np.concatenate([part.colors for part in parts])[often],
        np.concatenate([part.normals for part in parts])[often],
        np.concatenate([part.frames for part in parts])[often],
    )


def brightness(normals: Floats, vector: Floats) -> Floats:
    """Returns how bright surfaces are under even light and a lamp, against the even light alone, `[M]`.

    Args:
        normals: unit, `[M, 3]`.
        vector: towards the lamp, as long as it is strong beside the even light, `[3]`.
    """
    return np.asarray(1.0 + np.maximum(normals @ vector, 0.0))


def sums(groups: Integers, values: Floats, count: int) -> Floats:
    """Returns the sums of values `[M, C]` over the rows of each group, `[count, C]`."""
    return np.stack([np.bincount(groups, column, count) for column in values.T], axis=1)


def robust_weights(differences: Floats, scale: float) -> Floats:
    """Returns how much observations count by Geman and McClure, `[M]`, 1 where nothing differs.

    Args:
        differences: of each from what is expected, `[M]`.
        scale: difference at which one counts a quarter.
    """
    return np.asarray(1.0 / (1.0 + (differences / scale) ** 2) ** 2)


def without(seen: Sightings, gains: Floats) -> Sightings:
    """Returns the sightings with each row's colour divided by its gain, `[M, 3]`."""
    return replace(seen, colors=seen.colors / gains)
