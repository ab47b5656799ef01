"""What a video says of a body's surface, direction by direction.

A picture tells where a place lies across the line of sight and nothing of where it lies along it. Seen from one side
alone, a Gaussian may stand anywhere on its line, be as long as it likes along it, and be transparent from behind.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.coverage import SEEN, Coverage, surface_frames
from occfusion.geometry.normals import vertex_normals

Floats = NDArray[np.float64]

HALF_ANGLE = 20.0
"""Degrees about a line by which looks spread (root mean square) when the place along it counts as half known."""
KNOWN_LOOKS = 3.0
"""Sum of looks (`geometry.coverage`) at which a place counts as half seen."""
UNSURE = 0.003
"""Metres that clothes stand off at which half of it is believed."""


@dataclass(frozen=True)
class Observability:
    """What a video says of each place of a surface in its canonical pose.

    Attributes:
        moments: mean of d d^t over the looks at a place, d the unit direction to the camera, `[V, 3, 3]`.
        passes: the same over all views: an outline is seen of places that face away too.
        axis: the direction of which the video says least, `[V, 3]`: the mean line of sight; of places that no frame
            shows, the normal.
        ignorance: how little it says of it, `[V]`, 0 seen from all round .. 1 from one direction, or not at all.
        unseen: `[V]`, 0 seen often .. 1 never.
        is_seen: bool `[V]`.
    """

    moments: Floats
    passes: Floats
    axis: Floats
    ignorance: Floats
    unseen: Floats
    is_seen: NDArray[np.bool_]

    def turns(self) -> Floats:
        """Returns by how many degrees the directions to the camera spread about their axis at each place, `[V]`.

        Root mean square over all views, whether they show the place or not: 0 from one side, 45 from all round.
        """
        along = np.linalg.eigvalsh(self.passes)[:, 2]
        return np.degrees(np.arcsin(np.sqrt(np.clip(1.0 - along, 0.0, 1.0))))

    def outline_ignorance(self, directions: Floats) -> Floats:
        """Returns how little masks say of where the outline at each place ends along a direction, `[V]`.

        0: it was seen from across that direction, from whichever side; 1: only along it.

        Args:
            directions: of length 1, in the canonical pose: one for each place, `[V, 3]`.
        """
        return _ignorance(1.0 - np.einsum("vi,vij,vj->v", directions, self.passes, directions))


def observe_surface(
    coverage: Coverage, vertices: NDArray[np.floating], faces: NDArray[np.integer]
) -> Observability:
    """Returns what views say of each place of a surface.

    Args:
        coverage: of the same places.
        vertices: in the canonical pose, `[V, 3]`, metres.
        faces: triangles, `[F, 3]`, corners counter-clockwise from outside.
    """
    points = vertices.astype(np.float64)
    frames = surface_frames(points, faces)
    moments, passes = (
        np.einsum("vki,vkl,vlj->vij", frames, found, frames) for found in (coverage.moments, coverage.passes)
    )
    spreads, axes = np.linalg.eigh(moments)
    is_seen = coverage.looks >= SEEN
    axis = np.where(is_seen[:, None], axes[:, :, 2], vertex_normals(points, faces))
    ignorance = np.where(is_seen, _ignorance(1.0 - spreads[:, 2]), 1.0)
    return Observability(
        moments, passes, axis, ignorance, 1.0 / (1.0 + (coverage.looks / KNOWN_LOOKS) ** 2), is_seen
    )


def _ignorance(across: Floats) -> Floats:
    """Returns how little looks say of a direction, from the mean squared sine of their angles to it."""
    half = math.sin(math.radians(HALF_ANGLE)) ** 2
    return np.asarray(1.0 / (1.0 + (np.maximum(across, 0.0) / half) ** 2))


@dataclass(frozen=True)
class ObservedSurface:
    """A body's surface as a video shows it.

    Attributes:
        known: what it says of each place.
        ignorance: mean of that of all places by their area, 0..1.
        turn: mean of `Observability.turns` likewise, degrees.
        thickness: how far clothes stand off at each place, `[V]`, metres; 0 where nothing is closed and nobody looked.
    """

    known: Observability
    ignorance: float
    turn: float
    thickness: Floats

    @property
    def heights(self) -> Floats:
        """How far off the body its dressed surface is taken to be, see `dressed_heights`, `[V]`, metres."""
        return dressed_heights(self.thickness, self.known)


def dressed_heights(thickness: Floats, known: Observability) -> Floats:
    """Returns how far off a body its dressed surface is taken to be where a video leaves that open, `[V]`, metres.

    Outlines tell how far skirts and hair stand off, and only at the sides. What is spread from there is wrong by a few
    millimetres everywhere, so that little counts for less than it says, and much for nearly all of it.

    Args:
        thickness: how far clothes stand off at each place, `[V]`, metres.
        known: what the video says of the same places.
    """
    worn = np.maximum(thickness, 0.0)
    return known.ignorance * worn**2 / (worn + UNSURE)
