"""Pictures of the avatar for visitors whose browser has no GPU: drawn here, they only have to show them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.geometry.rotation import quaternion_to_matrix
from occfusion.human.rendering import Renderer
from occfusion.show.drawing import footprint
from occfusion.types import Camera, Cloud
from occfusion.viewer.figure import Figure
from occfusion.viewer.room import BACKGROUND, UNITS

MOST_SIDE = 800
"""Pixels of the longer side; larger pages show pictures enlarged."""
JPEG_QUALITY = 85
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
    """Returns a picture `[H, W, 3]` and its depths `[H, W]`, units of the scene, far away where nobody is.

    Args:
        cloud: the person, upright frame.
        figure: whom it is of.
        camera: in the upright frame.
        renderer: draws.
    """
    distance = max(float((cloud.means.mean(dim=0) - camera.centre).norm()), 1e-3)
    scale = float(camera.K[0, 0]) * figure.run.pixel / distance
    drawn = renderer.draw(replace(cloud, dilation=footprint(cloud.dilation, scale)), camera)
    behind = torch.tensor(BACKGROUND, dtype=torch.float32) / 255.0
    rgb = drawn.rgb + (1.0 - drawn.alpha[..., None]) * behind
    depth = torch.where(drawn.alpha > 0.5, drawn.depth * UNITS, _FAR)
    return (255.0 * rgb.clamp(0.0, 1.0)).round().byte().numpy(), depth.numpy()
