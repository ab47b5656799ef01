"""Things that stand or move between the first camera and the person: boxes, poles, furniture, a passer-by, a counter.

Their width, or a counter's height, is fitted to the take, so that a wanted share of the person is hidden from the
first camera.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.normals import vertex_normals
from occfusion.synth.rotations import Floats
from occfusion.synth.shading import Mesh
from occfusion.synth.studio import StudioCamera

SHARES = (0.30, 0.48)  # of the person that should be hidden, over the take
DISTANCE = (0.95, 1.3)  # metres from the middle of the studio, towards the first camera
NARROWEST, WIDEST, WIDEST_PASSER = 0.02, 1.2, 0.6  # metres
CROSSING = 60  # frames in which a moving thing goes across and back

WOOD = (0.46, 0.31, 0.19)
COLOURS = ((0.50, 0.42, 0.30), (0.30, 0.36, 0.42), (0.55, 0.54, 0.50), (0.34, 0.22, 0.17), (0.25, 0.33, 0.27))
_CUBE_FACES = np.array(
    [
        [0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
        [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],
    ]
)  # fmt: skip

Solid = tuple[Floats, NDArray[np.int64], tuple[float, float, float]]
"""Vertices (x across the line of sight, y towards the camera, z up, from the thing's foot), faces, colour."""


def _block(
    low: tuple[float, float, float], high: tuple[float, float, float], colour: tuple[float, float, float]
) -> Solid:
    corners = np.array(
        [[x, y, z] for z in (low[2], high[2]) for y in (low[1], high[1]) for x in (low[0], high[0])]
    )
    return corners, _CUBE_FACES, colour


def _column(x: float, y: float, radius: float, height: float, colour: tuple[float, float, float]) -> Solid:
    sides = 16
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)
    vertices = np.concatenate(
        [np.column_stack([ring, np.zeros(sides)]), np.column_stack([ring, np.full(sides, height)])]
    )
    here, there = np.arange(sides), (np.arange(sides) + 1) % sides
    faces = np.concatenate(
        [np.stack([here, there, here + sides], 1), np.stack([there, there + sides, here + sides], 1)]
    )
    lid = np.stack([np.full(sides - 2, sides), sides + here[1:-1], sides + here[2:]], 1)
    return vertices, np.concatenate([faces, lid]), colour


def _boxes(width: float, rng: np.random.Generator) -> list[Solid]:
    solids, base = [], 0.0
    for k in range(int(rng.integers(2, 4))):
        half = 0.5 * width * rng.uniform(0.8, 1.1)
        height, shift = rng.uniform(0.45, 0.75), width * rng.uniform(-0.15, 0.15)
        colour = COLOURS[(k + int(rng.integers(5))) % 5]
        solids.append(_block((shift - half, -0.2, base), (shift + half, 0.2, base + height), colour))
        base += height
    return solids


def _poles(width: float, rng: np.random.Generator) -> list[Solid]:
    count = int(rng.integers(2, 4))
    places = (np.arange(count) - 0.5 * (count - 1)) * 0.20 + rng.uniform(-0.03, 0.03, count)
    return [
        _column(
            float(x), float(rng.uniform(-0.2, 0.2)), 0.5 * width / count, 2.5, COLOURS[int(rng.integers(5))]
        )
        for x in places
    ]


def _furniture(width: float, rng: np.random.Generator) -> list[Solid]:
    half, top = 0.5 * width + 0.15, rng.uniform(0.50, 0.62)
    table = [_block((-half, -0.3, top - 0.05), (half, 0.3, top), WOOD)]
    for x in (-half, half - 0.06):
        for y in (-0.3, 0.24):
            table.append(_block((x, y, 0.0), (x + 0.06, y + 0.06, top), WOOD))
    front = _block((-0.42 * half, 0.26, 0.10), (0.42 * half, 0.29, top), (0.40, 0.26, 0.15))
    side = float(rng.choice([-1.0, 1.0])) * 0.35 * half
    reach = 0.06 + 0.4 * width
    screen = _block((side - reach, -0.1, top), (side + reach, 0.0, top + 0.45), (0.12, 0.12, 0.13))
    plant = _column(-side, 0.0, 0.04 + 0.25 * width, top + rng.uniform(0.35, 0.6), (0.20, 0.34, 0.18))
    return [*table, front, screen, plant]


def _passer(width: float, rng: np.random.Generator) -> list[Solid]:
    colour = COLOURS[int(rng.integers(5))]
    body = _column(0.0, 0.0, 0.5 * width, 1.45, colour)
    board = _block((-0.62 * width, -0.06, 0.45), (0.62 * width, -0.02, 1.25), COLOURS[int(rng.integers(5))])
    return [body, board, _column(0.0, 0.0, 0.22 * width, 1.75, (0.5, 0.4, 0.33))]


def _counter(height: float, rng: np.random.Generator) -> list[Solid]:
    """Returns a closed counter as wide as the picture; its height is what is fitted."""
    front, board = COLOURS[int(rng.integers(5))], COLOURS[int(rng.integers(5))]
    body = _block((-1.0, -0.2, 0.0), (1.0, 0.2, 0.96 * height), front)
    return [body, _block((-1.0, -0.25, 0.96 * height), (1.0, 0.25, height), board)]


_BUILDERS: dict[str, Callable[[float, np.random.Generator], list[Solid]]] = {
    "boxes": _boxes,
    "furniture": _furniture,
    "moving": _passer,
    "poles": _poles,
    "counter": _counter,
}
"""By kind; the place of a kind in this list enters its random numbers, so new ones come last."""


class Occluder:
    """One arrangement of things; a function of the frame alone."""

    def __init__(self, kind: str, seed: int, subject: int, camera: StudioCamera) -> None:
        rng = np.random.default_rng([seed, subject, 9, list(_BUILDERS).index(kind)])
        self.kind = kind
        self.wanted = float(rng.uniform(*SHARES))
        self._build_seed = int(rng.integers(2**31))
        self._distance = float(rng.uniform(*DISTANCE))
        self._phase = float(rng.uniform(0.0, 1.0))
        towards = camera.centre * [1.0, 1.0, 0.0]
        self._towards = towards / np.linalg.norm(towards)
        self._across = np.array([-self._towards[1], self._towards[0], 0.0])

    @property
    def is_moving(self) -> bool:
        """Says whether it is elsewhere in each frame."""
        return self.kind == "moving"

    def mesh(self, width: float, frame: float) -> Mesh:
        """Returns it in the world at a frame; `width` in metres (a counter's height) is what is fitted."""
        solids = _BUILDERS[self.kind](width, np.random.default_rng(self._build_seed))
        shift = 0.0
        if self.is_moving:
            shift = 0.55 * np.sin(2.0 * np.pi * (frame / CROSSING + self._phase))
        vertices, faces, layers, count = [], [], [], 0
        texture = np.zeros((len(solids), 2, 2, 3), np.float32)
        for k, (points, triangles, colour) in enumerate(solids):
            origin = self._towards * self._distance + self._across * shift
            world = origin + points[:, :1] * self._across + points[:, 1:2] * self._towards
            world[:, 2] = points[:, 2]
            # corners of their own for each triangle give flat shading
            vertices.append(world[triangles].reshape(-1, 3))
            faces.append(count + np.arange(3 * len(triangles)).reshape(-1, 3))
            layers.append(np.full(len(triangles), k))
            texture[k] = colour
            count += 3 * len(triangles)
        points = np.concatenate(vertices)
        triangles = np.concatenate(faces)
        normals = vertex_normals(points, triangles)
        light = 0.55 + 0.45 * np.abs(normals @ np.array([0.45, -0.55, 0.70]))
        return Mesh(
            points, light, triangles, np.full((len(triangles), 3, 2), 0.5), np.concatenate(layers), texture
        )

    def fit(self, hidden_share: Callable[[float], float]) -> float:
        """Returns the width with which the wanted share of the person is hidden, metres.

        Args:
            hidden_share: share of the person hidden from the first camera for a width.
        """
        low, high = NARROWEST, WIDEST_PASSER if self.is_moving else WIDEST
        for _ in range(7):
            middle = 0.5 * (low + high)
            if hidden_share(middle) < self.wanted:
                low = middle
            else:
                high = middle
        return 0.5 * (low + high)
