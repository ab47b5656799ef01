"""Where a frame's body lies in its picture: the region of interest, and the key points seen in it (paper §4.1)."""

from __future__ import annotations

import torch

from occfusion.geometry.camera import project_vertices
from occfusion.priors.bodyview import view_body
from occfusion.priors.keypoints import Keypoints, see_keypoints
from occfusion.priors.masks import Observation
from occfusion.priors.region import Region


def body_region(observation: Observation, margin: int, resolution: int = 0) -> Region | None:
    """Returns the region around a frame's body; None where the body is outside the picture.

    Args:
        observation: the frame.
        margin: pixels around the body's box.
        resolution: longer side at work, pixels; 0: the region's own size.
    """
    camera = observation.camera
    pixels, depths = project_vertices(
        observation.vertices, camera.viewmat.double().numpy(), camera.K.double().numpy()
    )
    height, width = observation.visible.shape
    return Region.around(pixels[depths > 0.01], (width, height), margin, resolution)


def body_keypoints(observation: Observation, region: Region, sigma: float) -> Keypoints:
    """Returns the key points in a region at work, without those that the body itself hides.

    Args:
        observation: the frame.
        region: in whose pixels, at work, the key points are given.
        sigma: how far behind the body's surface a point may lie, metres.
    """
    camera = region.camera(observation.camera)
    projected = project_vertices(
        observation.vertices, camera.viewmat.double().numpy(), camera.K.double().numpy()
    )
    depth = view_body(*projected, observation.faces, camera.width, camera.height).depth
    return see_keypoints(torch.from_numpy(observation.keypoints), camera, depth, sigma)
