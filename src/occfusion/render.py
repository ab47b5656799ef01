"""Avatar x camera -> picture, outside training."""

from __future__ import annotations

import torch

from occfusion.human.avatar import Avatar
from occfusion.splat import Limits, rasterize
from occfusion.types import Camera, Cloud, Frame, Rendering


def render_cloud(
    cloud: Cloud, camera: Camera, backend: str, background: torch.Tensor | None = None
) -> Rendering:
    """Returns the picture of posed Gaussians; black behind them when `background` `[3]` is None."""
    return rasterize(
        cloud.means, None, None, cloud.opacities, cloud.colors, camera.viewmat, camera.K,
        camera.width, camera.height, background=background, covariances=cloud.covariances, backend=backend,
        limits=Limits(dilation=cloud.dilation),
    )  # fmt: skip


def canonical_alpha(avatar: Avatar, camera: Camera, backend: str) -> torch.Tensor:
    """Returns the occupancy of the canonical pose, `[H, W]`; differentiable, colours left out."""
    cloud = avatar.canonical(camera.centre)
    return _alpha(avatar, cloud.means, cloud.covariances, camera, backend)


@torch.no_grad()
def outline(avatar: Avatar, frame: Frame, backend: str) -> torch.Tensor:
    """Returns what an avatar covers by more than half in a frame's pose and camera, bool `[H, W]`; colours left out."""
    carried = avatar.deform(frame.pose)
    return _alpha(avatar, carried.means, carried.covariances, frame.camera, backend) > 0.5


def _alpha(
    avatar: Avatar, means: torch.Tensor, covariances: torch.Tensor, camera: Camera, backend: str
) -> torch.Tensor:
    return rasterize(
        means, None, None, avatar.gaussians.opacities, torch.zeros_like(means), camera.viewmat, camera.K,
        camera.width, camera.height, covariances=covariances, backend=backend,
        limits=Limits(dilation=avatar.dilation),
    ).alpha  # fmt: skip


@torch.inference_mode()
def render_frame(avatar: Avatar, frame: Frame, backend: str) -> Rendering:
    """Returns the avatar in a frame's pose as that frame's camera sees it, over black; no gradients."""
    return render_cloud(avatar(frame.pose, frame.camera.centre), frame.camera, backend)
