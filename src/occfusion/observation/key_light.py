"""Where the light comes from, told by how the colours of body points change as they turn.

A point of the body is seen in many frames, facing other ways. What changes with the direction it faces, for all points
alike, is light: even light from all around and one far lamp, by Lambert's law. Each point's own colour drops out
(variable projection: Golub and Pereyra 1973). From one camera a general light (harmonics over normals) is not
determined along the line of sight; a lamp's is, by where its light ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.normals import vertex_normals
from occfusion.observation.bodyview import view_body
from occfusion.observation.evidence import person_size
from occfusion.observation.frames import ObservedFrame
from occfusion.types import Frame

Floats = NDArray[np.float64]

FRAMES = 50
"""Frames that are looked at, evenly spread; more say the same."""
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

STEPS, EVEN_STEPS = 40, 5
"""Rounds of weighing, at most, with a lamp to find and without."""
DAMPING, SHORT = 1e-3, 1e-4
LONGEST_STEP = 0.2
STRONGEST = 5.0
"""Times the even light; a lamp that is stronger is not told from any other, all else being dark."""
CUT = 2.0
"""Median differences from which on an observation counts little: another garment, a seam, a wrong pose."""


@dataclass(frozen=True)
class Sightings:
    """Points of the body as frames show them, a row each.

    Attributes:
        points: vertex numbers, `[M]`.
        colors: `[M, 3]`, 0..1.
        normals: of the body's surface in the world, unit, `[M, 3]`.
    """

    points: NDArray[np.int64]
    colors: Floats
    normals: Floats


@dataclass(frozen=True)
class KeyLight:
    """An estimated lamp.

    Attributes:
        vector: towards the lamp, as long as it is strong beside the even light, `[3]`.
        before: how far a point's colour lies from its own mean under even light, median over sightings, 0..1.
        after: the same with the lamp.
        condition: of the lamp's three numbers: the largest over the smallest curvature of the error.
    """

    vector: Floats
    before: float
    after: float
    condition: float

    @property
    def explained(self) -> float:
        """Share of the differences that the lamp explains, 0..1."""
        return 1.0 - self.after / self.before if self.before > 0.0 else 0.0


def find_key_light(
    read: Callable[[int], Frame], observed_frames: Sequence[ObservedFrame], faces: NDArray[np.integer]
) -> KeyLight | None:
    """Returns the lamp that a video shows, or None where too little is seen to tell.

    Args:
        read: gives the training frame at a position, without truth.
        observed_frames: what is known of each.
        faces: of the body mesh, `[F, 3]`.
    """
    positions = np.unique(
        np.linspace(0, len(observed_frames) - 1, min(FRAMES, len(observed_frames))).round().astype(int)
    )
    return fit_key_light(join([sight(read(int(k)), observed_frames[k], faces) for k in positions]))


def sight(frame: Frame, observed_frame: ObservedFrame, faces: NDArray[np.integer]) -> Sightings:
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
    return Sightings(points, smooth[rows, columns].astype(np.float64), normals[points])


def join(parts: Sequence[Sightings]) -> Sightings:
    """Returns the sightings of points that are seen often enough to tell how they change."""
    points = np.concatenate([part.points for part in parts])
    often = np.bincount(points, minlength=1)[points] >= SIGHTINGS
    return Sightings(
        points[often],
        np.concatenate([part.colors for part in parts])[often],
        np.concatenate([part.normals for part in parts])[often],
    )


def fit_key_light(seen: Sightings) -> KeyLight | None:
    """Returns the lamp that makes each point's colour, divided by its brightness, vary least; None where nothing tells.

    Gauss-Newton with Geman and McClure's weights, from six sides; the best end is taken.
    """
    points = np.unique(seen.points, return_inverse=True)[1]
    if not len(points) or points.max() + 1 < POINTS:
        return None
    fit, dark = _Fit(points, seen.colors, seen.normals), np.zeros(3)
    usual = float(np.median(fit.differences(dark)))
    if usual <= 0.0:
        return None
    fit.scale = CUT * usual
    for _ in range(EVEN_STEPS):
        fit.weigh(dark)
    before, cost_before = float(np.median(fit.differences(dark))), fit.cost(dark)
    ends = [end for start in np.vstack([np.eye(3), -np.eye(3)]) if (end := fit.descend(LONGEST_STEP * start))]
    if not ends:
        return None
    vector, cost, condition = min(ends, key=lambda end: end[1])
    if cost >= cost_before:
        return None
    for _ in range(EVEN_STEPS):
        fit.weigh(vector)
    return KeyLight(vector, before, float(np.median(fit.differences(vector))), condition)


class _Fit:
    """The error of a lamp, each point's own colour being the best for it."""

    def __init__(self, points: NDArray[np.int64], colors: Floats, normals: Floats) -> None:
        self.points, self.colors, self.normals = points, colors, normals
        self.count = int(points.max()) + 1
        self.scale = np.inf
        self._weights = np.ones(len(points))

    def differences(self, vector: Floats) -> Floats:
        """Returns how far each sighting lies from its point's colour under the lamp, `[M]`."""
        return np.asarray(np.linalg.norm(self._residual(vector, self._weights)[0], axis=1))

    def cost(self, vector: Floats) -> float:
        """Returns Geman and McClure's error of a lamp."""
        squared = (self.differences(vector) / self.scale) ** 2
        return float((squared / (1.0 + squared)).mean())

    def weigh(self, vector: Floats) -> None:
        """Has each sighting count by how well it fits under a lamp."""
        squared = (self.differences(vector) / self.scale) ** 2
        self._weights = 1.0 / (1.0 + squared) ** 2

    def descend(self, vector: Floats) -> tuple[Floats, float, float] | None:
        """Returns where Gauss-Newton ends from a start, its cost and condition; None if it leads nowhere."""
        self._weights = np.ones(len(self.points))
        hessian = np.eye(3)
        for _ in range(STEPS):
            self.weigh(vector)
            residual, own, light = self._residual(vector, self._weights)
            lit = self.normals * (self.normals @ vector > 0.0)[:, None]
            # what the points' own colours take over of a change of the lamp is no error
            taken = self._sums(self._weights * light, lit) / self._norm(self._weights, light)[:, None]
            change = lit - light[:, None] * taken[self.points]
            weighted = change * self._weights[:, None]
            hessian = (weighted * (own**2).sum(axis=1)[:, None]).T @ change
            gradient = weighted.T @ (residual * own).sum(axis=1)
            size = float(np.trace(hessian)) / 3.0
            if not size > 0.0:
                return None
            step = np.linalg.solve(hessian + DAMPING * size * np.eye(3), gradient)
            length = float(np.linalg.norm(step))
            vector = vector + step * min(1.0, LONGEST_STEP / max(length, SHORT))
            strength = float(np.linalg.norm(vector))
            vector = vector * min(1.0, STRONGEST / max(strength, SHORT))
            if length < SHORT:
                break
        low, *_, high = np.linalg.eigvalsh(hessian)
        return vector, self.cost(vector), float(high / max(low, 1e-12 * high))

    def _residual(self, vector: Floats, weights: Floats) -> tuple[Floats, Floats, Floats]:
        light = 1.0 + np.maximum(self.normals @ vector, 0.0)
        colors = self._sums(weights * light, self.colors) / self._norm(weights, light)[:, None]
        own = colors[self.points]
        return self.colors - own * light[:, None], own, light

    def _sums(self, weights: Floats, values: Floats) -> Floats:
        sums = [np.bincount(self.points, weights * column, self.count) for column in values.T]
        return np.stack(sums, axis=1)

    def _norm(self, weights: Floats, light: Floats) -> Floats:
        return np.maximum(np.bincount(self.points, weights * light**2, self.count), 1e-12)
