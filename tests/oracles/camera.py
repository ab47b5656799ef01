"""Where points appear in a picture, differentiable."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from occfusion.types import Camera

NEAR = 0.01
"""Metres; nearer points have no place in the picture."""


def project_points(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Returns where points appear and how far away they are.

    Args:
        points: world coordinates in metres, `[..., 3]`.
        camera: whose picture it is.

    Returns:
        pixel positions `[..., 2]` (NaN, with zero gradient, for points less than 1 cm before the camera
        plane, which have none) and depths along the viewing direction `[...]`, metres.
    """
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    depths = local[..., 2]
    is_seen = (depths >= NEAR).unsqueeze(-1)
    # the division only ever sees depths that are kept, so those dropped cannot spoil the gradient
    rays = local[..., :2] / torch.where(is_seen, depths.unsqueeze(-1), 1.0)
    pixels = rays @ camera.K[:2, :2].T + camera.K[:2, 2]
    return torch.where(is_seen, pixels, math.nan), depths
