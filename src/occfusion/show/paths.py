"""Paths of cameras: which frame of a motion each picture shows, and from where."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from occfusion.errors import ConfigError
from occfusion.geometry.camera import look_at
from occfusion.motion.performance import Performance
from occfusion.show.views import View
from occfusion.types import Camera

FIELD_OF_VIEW = math.radians(40)
"""Of the shorter side of pictures that nobody else has a camera for."""
MARGIN = 1.12
"""Room around the person."""
RISE = math.radians(12)
"""How high above the person's middle a spiral's camera begins and ends, and how low it gets between."""
SPIRAL_TURNS = 2.0


@dataclass(frozen=True)
class Shot:
    """One picture to be drawn.

    Attributes:
        row: frame of the performance; None: the canonical pose.
        camera: in the world of the performance's clip.
        scale: size of a picture's pixel on the person beside that of the training pictures' pixels, inverted: at 4
            one pixel of these became 4 x 4.
        caption: what a picture beside it is called.
    """

    row: int | None
    camera: Camera
    scale: float
    caption: str = ""


@dataclass(frozen=True)
class Framing:
    """What all pictures of a path have in common.

    Attributes:
        width: pixels.
        height: pixels.
        pixel: what a pixel of the training pictures covers at the person, metres.
    """

    width: int
    height: int
    pixel: float

    @property
    def focal(self) -> float:
        """Focal length of `FIELD_OF_VIEW`, pixels."""
        return 0.5 * min(self.width, self.height) / math.tan(0.5 * FIELD_OF_VIEW)

    def distance(self, low: Sequence[float], high: Sequence[float]) -> float:
        """Returns how far a camera has to be from the middle of a box that turns about its upright axis, metres."""
        reach = max(math.hypot(x, z) for x in (low[0], high[0]) for z in (low[2], high[2]))
        half_height = 0.5 * (high[1] - low[1])
        needed = max(half_height * 2 * self.focal / self.height, reach * 2 * self.focal / self.width)
        return MARGIN * needed + reach

    def camera(self, eye: Tensor, target: Tensor) -> Camera:
        """Returns a camera of the upright frame that looks from one place to another."""
        f, w, h = self.focal, self.width, self.height
        K = torch.tensor([[f, 0.0, w / 2], [0.0, f, h / 2], [0.0, 0.0, 1.0]])
        return Camera(look_at(eye, target, torch.tensor([0.0, 1.0, 0.0])), K, w, h)


def orbit(
    performance: Performance,
    rows: Sequence[int],
    angles: Sequence[float],
    rises: Sequence[float],
    framing: Framing,
) -> list[Shot]:
    """Returns shots from around the person, whose way over the floor the camera follows.

    Args:
        performance: the motion.
        rows: its frame in each picture.
        angles: places of the camera around the person, radians; 0 sees the first frame from the front.
        rises: its elevation above the person's middle, radians.
        framing: of the pictures.
    """
    low, high = performance.low.tolist(), performance.high.tolist()
    # joints end at wrists and ankles and the top of the neck
    low, high = [value - 0.12 for value in low], [value + 0.12 for value in high]
    high[1] += 0.1
    distance = framing.distance(low, high)
    middle = 0.5 * (low[1] + high[1])
    shots = []
    for row, angle, rise in zip(rows, angles, rises, strict=True):
        x, _, z = performance.paths[row].tolist()
        target = torch.tensor([x, middle, z])
        flat = distance * math.cos(rise)
        eye = target + torch.tensor(
            [flat * math.sin(angle), distance * math.sin(rise), flat * math.cos(angle)]
        )
        camera = framing.camera(eye, target)
        own = replace(camera, viewmat=camera.viewmat @ performance.upright)
        shots.append(Shot(row, own, framing.focal / distance * framing.pixel))
    return shots


def turntable(performance: Performance, rows: Sequence[int], framing: Framing) -> list[Shot]:
    """Returns one turn around the person, ending a step before where it began."""
    count = len(rows)
    return orbit(performance, rows, [2 * math.pi * k / count for k in range(count)], [0.0] * count, framing)


def spiral(performance: Performance, rows: Sequence[int], framing: Framing) -> list[Shot]:
    """Returns turns around the person that sink from above it to below its middle and rise again."""
    count = len(rows)
    angles = [2 * math.pi * SPIRAL_TURNS * k / count for k in range(count)]
    rises = [RISE * math.cos(2 * math.pi * k / count) for k in range(count)]
    return orbit(performance, rows, angles, rises, framing)


def bullet_time(performance: Performance, moment: int, count: int, framing: Framing) -> list[Shot]:
    """Returns the motion up to a moment, one turn around the person while time stands, and the rest of the motion.

    Args:
        performance: the motion.
        moment: its frame at which time stands.
        count: pictures of the turn.
        framing: of the pictures.
    """
    if not 0 <= moment < len(performance):
        raise ConfigError(f"--moment {moment}: the motion has the frames 0 to {len(performance) - 1}")
    before, after = list(range(moment)), list(range(moment, len(performance)))
    rows = [*before, *[moment] * count, *after]
    turning = [2 * math.pi * k / count for k in range(count)]
    angles = [*[0.0] * len(before), *turning, *[0.0] * len(after)]
    return orbit(performance, rows, angles, [0.0] * len(rows), framing)


def still(
    performance: Performance,
    rows: Sequence[int],
    views: Sequence[View],
    to_clip: Tensor,
    size: tuple[int, int] | None,
    pixel: float | None = None,
) -> list[Shot]:
    """Returns shots from given cameras, in turn.

    Args:
        performance: the motion.
        rows: its frame in each picture, as many as there are views.
        views: cameras in the world of the sequence that the avatar learned from.
        to_clip: from that world to the one of the performance's clip, `[4, 4]`.
        size: of the pictures, into which those of the cameras are fitted whole; None: each has its own.
        pixel: what a pixel of the training pictures covers at the person, metres; None: these cameras were trained
            or evaluated on, and their own pictures have the training pictures' footprint.
    """
    shots = []
    for row, view in zip(rows, views, strict=True):
        camera, scale = view.camera, 1.0
        if size is not None:
            camera, scale = fitted(camera, *size)
        own = replace(camera, viewmat=camera.viewmat @ torch.linalg.inv(to_clip.double()).float())
        if pixel is not None:
            there = torch.from_numpy(performance.clip.transl[row]).float()
            scale = float(camera.K[0, 0] / (there - own.centre).norm().clamp_min(1e-3)) * pixel
        shots.append(Shot(row, own, scale, view.name))
    return shots


def fitted(camera: Camera, width: int, height: int) -> tuple[Camera, float]:
    """Returns a camera whose picture lies in the middle of one of another size, whole, and how much it grew."""
    scale = min(width / camera.width, height / camera.height)
    K = camera.K.clone()
    K[:2] *= scale
    K[0, 2] += 0.5 * (width - scale * camera.width)
    K[1, 2] += 0.5 * (height - scale * camera.height)
    return Camera(camera.viewmat, K, width, height), scale
