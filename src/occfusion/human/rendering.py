"""Avatar x camera -> picture, outside training."""

from __future__ import annotations

import torch

from occfusion.human.avatar import Avatar
from occfusion.splat import Limits, fitting_backend, rasterize
from occfusion.types import Camera, Cloud, Frame, Rendering


def render_cloud(
    cloud: Cloud, camera: Camera, backend: str, background: torch.Tensor | None = None
) -> Rendering:
    """Returns the picture of posed Gaussians; black behind them when `background` `[3]` is None.

    It is made where the Gaussians are, by another backend where `backend` does not run there.
    """
    device = cloud.means.device
    camera, backend = camera.to(device), fitting_backend(backend, device)
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
    carried = avatar.deform(frame.pose.to(avatar.gaussians.means.device))
    return _alpha(avatar, carried.means, carried.covariances, frame.camera, backend) > 0.5


def _alpha(
    avatar: Avatar, means: torch.Tensor, covariances: torch.Tensor, camera: Camera, backend: str
) -> torch.Tensor:
    camera, backend = camera.to(means.device), fitting_backend(backend, means.device)
    return rasterize(
        means, None, None, avatar.gaussians.opacities, torch.zeros_like(means), camera.viewmat, camera.K,
        camera.width, camera.height, covariances=covariances, backend=backend,
        limits=Limits(dilation=avatar.dilation),
    ).alpha  # fmt: skip


@torch.inference_mode()
def render_frame(avatar: Avatar, frame: Frame, backend: str) -> Rendering:
    """Returns the avatar in a frame's pose as that frame's camera sees it, over black; no gradients."""
    device = avatar.gaussians.means.device
    camera = frame.camera.to(device)
    return render_cloud(avatar(frame.pose.to(device), camera.centre), camera, backend)
