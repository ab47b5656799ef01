"""Avatar x camera -> picture."""

from __future__ import annotations

import time

import torch
from torch import Tensor

from occfusion.human.avatar import Avatar
from occfusion.splat import Limits, fitting_backend, rasterize, resolve_backend
from occfusion.types import Box, Camera, Cloud, Frame, Pose, Rendering

WARM_UP_SIZE = 16
"""Pixels; kernels are compiled for types of arrays, not for sizes."""


class Renderer:
    """Draws posed Gaussians with one backend; built once a run and handed to all that draw.

    A picture is made where the Gaussians are. Of an avatar that is read from a file that can be where the backend does
    not run; the best one there is taken then.

    Args:
        backend: rasteriser backend; `auto` for the best on `device`.
        device: where the run trains.

    Raises:
        ConfigError: the backend is unknown or does not run on the device.
    """

    def __init__(self, backend: str, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self.backend = resolve_backend(backend, self.device)

    def draw(
        self,
        cloud: Cloud,
        camera: Camera,
        *,
        crop: Box | None = None,
        screen_offsets: Tensor | None = None,
    ) -> Rendering:
        """Returns the picture of posed Gaussians over black; arguments as in `splat.rasterize`.

        Args:
            cloud: drawn with its own dilation.
            camera: on any device.
            crop: window `(x, y, width, height)` to compute; the whole picture when None.
            screen_offsets: `[N, 2]` pixels, added to the projected centres.
        """
        device = cloud.means.device
        return rasterize(
            cloud.means, None, None, cloud.opacities, cloud.colors, camera.viewmat, camera.K,
            camera.width, camera.height, covariances=cloud.covariances,
            backend=fitting_backend(self.backend, device), crop=crop, screen_offsets=screen_offsets,
            limits=Limits(dilation=cloud.dilation),
        )  # fmt: skip

    def canonical(self, avatar: Avatar, colors: Tensor, camera: Camera) -> Rendering:
        """Returns the picture of an avatar's canonical pose over black; differentiable.

        The rasteriser takes turns and scales as they are: a covariance that no pose has changed, with its gradient,
        costs autograd as much as the picture.

        Args:
            avatar: on any device.
            colors: of its Gaussians, `[N, 3]`, 0..1.
            camera: on any device.
        """
        gaussians = avatar.gaussians
        device = gaussians.means.device
        return rasterize(
            gaussians.means, gaussians.raw_quats, gaussians.scales, gaussians.opacities, colors, camera.viewmat,
            camera.K, camera.width, camera.height, backend=fitting_backend(self.backend, device),
            limits=Limits(dilation=avatar.dilation),
        )  # fmt: skip

    def posed(self, avatar: Avatar, pose: Pose, colors: Tensor, camera: Camera) -> Rendering:
        """Returns the picture of an avatar's Gaussians in a pose over black; what was learned of poses is left out.

        Differentiable in the Gaussians alone.

        Args:
            avatar: on any device.
            pose: on any device.
            colors: of its Gaussians, `[N, 3]`, 0..1.
            camera: on any device.
        """
        opacities = avatar.gaussians.opacities
        means, covariances, _ = avatar.deform(pose.to(opacities.device), as_given=True)
        return self.draw(Cloud(means, covariances, opacities, colors, avatar.dilation), camera)

    @torch.inference_mode()
    def frame(self, avatar: Avatar, frame: Frame) -> Rendering:
        """Returns the avatar in a frame's pose as that frame's camera sees it, over black; no gradients."""
        device = avatar.gaussians.means.device
        camera = frame.camera.to(device)
        return self.draw(avatar(frame.pose.to(device), camera.centre), camera)

    def canonical_alpha(self, avatar: Avatar, camera: Camera) -> Tensor:
        """Returns the occupancy of the canonical pose, `[H, W]`; differentiable, colours left out."""
        return self.canonical(avatar, torch.zeros_like(avatar.gaussians.means), camera).alpha

    @torch.no_grad()
    def outline(self, avatar: Avatar, frame: Frame) -> Tensor:
        """Returns what an avatar covers by more than half in a frame's pose and camera, bool `[H, W]`."""
        pose = frame.pose.to(avatar.gaussians.means.device)
        means, covariances, _ = avatar.deform(pose)
        black = torch.zeros_like(means)
        cloud = Cloud(means, covariances, avatar.gaussians.opacities, black, avatar.dilation)
        return self.draw(cloud, frame.camera).alpha > 0.5

    def warm_up(self) -> float:
        """Draws a tiny picture forwards and backwards; returns the seconds that it took.

        After this no call in float32 compiles anything: `numba` needs about ten seconds where its cache is empty and
        one where it is not, `gsplat` builds or loads its extension.
        """
        started = time.monotonic()
        with torch.inference_mode(False), torch.enable_grad():
            means = torch.tensor([[0.0, 0.0, 1.0]], device=self.device, requires_grad=True)
            colors = torch.ones(1, 3, device=self.device, requires_grad=True)
            middle = WARM_UP_SIZE / 2
            K = torch.tensor([[2 * middle, 0.0, middle], [0.0, 2 * middle, middle], [0.0, 0.0, 1.0]])
            camera = Camera(torch.eye(4), K, WARM_UP_SIZE, WARM_UP_SIZE)
            covariances = 0.01 * torch.eye(3, device=self.device)[None]
            opacities = torch.ones(1, device=self.device)
            # what a stage learns; and colours alone, by which those that the video shows are gathered at the start
            for centres, shades in ((means, colors.detach()), (means.detach(), colors)):
                drawn = self.draw(Cloud(centres, covariances, opacities, shades, Limits.dilation), camera)
                (drawn.rgb.sum() + drawn.alpha.sum()).backward()
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.monotonic() - started
