"""Pictures of the avatar for visitors whose browser has no GPU: drawn here, they only have to show them."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.geometry.rotation import quaternion_to_matrix
from occfusion.human.rendering import Renderer
from occfusion.show.drawing import footprint
from occfusion.types import Camera, Cloud
from occfusion.viewer.figure import Figure
from occfusion.viewer.room import BACKGROUND, FLOOR_CELL, FLOOR_SIDE, UNITS

MOST_SIDE = 800
"""Pixels of the longer side; larger pages show pictures enlarged."""
JPEG_QUALITY = 85
_LINE = (110, 110, 110)
"""Colour of the floor's lines."""
_NEAR = 0.05
"""Metres before a camera from which on lines are drawn."""
_SUBPIXEL_BITS = 4
_FAR = 160.0
"""Of what is behind the person, units of the scene; viser packs depths up to 167."""


def camera_of(visitor: Any) -> Camera:
    """Returns the camera of a visitor, in the upright frame and metres.

    Args:
        visitor: `viser.CameraHandle`: its `position` in units of the scene, `wxyz`, vertical `fov`, and size in pixels.
    """
    shrink = min(1.0, MOST_SIDE / max(visitor.image_width, visitor.image_height))
    width, height = (max(round(shrink * side), 1) for side in (visitor.image_width, visitor.image_height))
    turn = quaternion_to_matrix(torch.tensor(np.asarray(visitor.wxyz, np.float64))).T
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = turn
    viewmat[:3, 3] = -turn @ torch.tensor(np.asarray(visitor.position, np.float64) / UNITS)
    focal = 0.5 * height / math.tan(0.5 * visitor.fov)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat.float(), K, width, height)


@torch.inference_mode()
def draw(
    cloud: Cloud, figure: Figure, camera: Camera, renderer: Renderer
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Returns a picture `[H, W, 3]` on the floor, and depths of the person `[H, W]`, units of the scene, else far away.

    Args:
        cloud: the person, upright frame.
        figure: whom it is of.
        camera: in the upright frame.
        renderer: draws.
    """
    distance = max(float((cloud.means.mean(dim=0) - camera.centre).norm()), 1e-3)
    scale = float(camera.K[0, 0]) * figure.run.pixel / distance
    drawn = renderer.draw(replace(cloud, dilation=footprint(cloud.dilation, scale)), camera)
    picture = floor(camera)
    covered = (drawn.alpha > 0.0).numpy()
    rows, columns = (np.flatnonzero(covered.any(axis=axis)) for axis in (1, 0))
    if len(rows):  # most of a page is not the person
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        alpha = drawn.alpha[box].unsqueeze(-1).numpy()
        rgb = 255.0 * drawn.rgb[box].clamp(0.0, 1.0).numpy() + (1.0 - alpha) * picture[box]
        picture[box] = np.minimum(rgb + 0.5, 255.0).astype(np.uint8)
    depth = torch.where(drawn.alpha > 0.5, drawn.depth * UNITS, _FAR)
    return picture, depth.numpy()


def floor(camera: Camera) -> NDArray[np.uint8]:
    """Returns a picture `[H, W, 3]` of the floor alone: lines in the plane y = 0 of the upright frame."""
    view, K = (matrix.double().numpy().tobytes() for matrix in (camera.viewmat, camera.K))
    return _floor(view, K, camera.width, camera.height).copy()


@lru_cache(maxsize=8)  # visitors stand still while motions play
def _floor(viewmat: bytes, intrinsics: bytes, width: int, height: int) -> NDArray[np.uint8]:
    view, K = np.frombuffer(viewmat).reshape(4, 4), np.frombuffer(intrinsics).reshape(3, 3)
    picture = np.full((height, width, 3), BACKGROUND, np.uint8)
    reach = FLOOR_SIDE / 2
    places = np.arange(-reach, reach + 1e-6, FLOOR_CELL)
    ends = np.stack([np.full_like(places, -reach), np.full_like(places, reach)], axis=1)
    along, flat = np.repeat(places[:, None], 2, axis=1), np.zeros((len(places), 2))
    lines = np.concatenate([np.stack([along, flat, ends], axis=2), np.stack([ends, flat, along], axis=2)])
    for start, end in lines @ view[:3, :3].T + view[:3, 3]:
        if max(start[2], end[2]) <= _NEAR:
            continue
        clipped = [_before(start, end), _before(end, start)]
        # pixel centres lie at +0.5, OpenCV's at whole numbers
        pixels = [(K[:2, :2] @ (each[:2] / each[2]) + K[:2, 2] - 0.5) * 2**_SUBPIXEL_BITS for each in clipped]
        if np.abs(pixels).max() < 2**30:
            first, last = (tuple(int(value) for value in each.round()) for each in pixels)
            cv2.line(picture, first, last, _LINE, 1, cv2.LINE_AA, _SUBPIXEL_BITS)
    return picture


def _before(place: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns a place in camera axes, or where the line to the other one passes `_NEAR`."""
    if place[2] >= _NEAR:
        return place
    return place + (other - place) * (_NEAR - place[2]) / (other[2] - place[2])
