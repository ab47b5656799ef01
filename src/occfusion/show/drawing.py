"""An avatar in a pose from a camera: colours, occupancy, depth, normals, at any size and in any light."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from occfusion.errors import ConfigError
from occfusion.geometry.winding import winding_number
from occfusion.human import Avatar
from occfusion.human.rendering import Renderer
from occfusion.human.shading import SHORTEST
from occfusion.motion.performance import Performance
from occfusion.show.paths import Shot
from occfusion.types import Cloud, Rendering

LAYERS = ("rgb", "alpha", "depth", "normals")
"""What can be drawn."""
EVEN, ESTIMATED = "even", "estimated"
LAMP_STRENGTH = 1.0
"""Of a lamp that is asked for, beside the even light."""
_INSIDE = 0.02
"""Metres to the nearest Gaussian's centre from which on a camera counts as within the body, whatever the mesh says."""
BOX_VARIANCE = 1.0 / 12.0
"""Of a pixel's square in each direction, square pixels."""


@dataclass(frozen=True)
class Light:
    """Which light an avatar is shown in.

    Attributes:
        kind: `even`, `estimated` or `lamp`.
        vector: towards the lamp, as long as it is strong beside the even light, upright frame `[3]`; None: no lamp.
    """

    kind: str
    vector: Tensor | None

    @property
    def text(self) -> str:
        """What files and pages say of it."""
        if self.kind != "lamp" or self.vector is None:
            return {EVEN: "even light", ESTIMATED: "the light estimated from the video"}[self.kind]
        x, y, z = functional.normalize(self.vector, dim=0).tolist()
        return (
            f"a lamp {math.degrees(math.atan2(x, z)):.0f} degrees to the person's left of the front and "
            f"{math.degrees(math.asin(max(-1.0, min(1.0, y)))):.0f} degrees high"
        )


def parse_light(words: str, avatar: Avatar, upright: Tensor) -> Light:
    """Returns the light of a user's word.

    Args:
        words: `even`, `estimated`, or `AZIMUTH,HEIGHT` of a lamp in degrees: 0,0 before the person, 90,0 at its left.
        avatar: with the lamp that was found while it was trained, where there was one.
        upright: from the avatar's own world to the upright frame, `[4, 4]`.

    Raises:
        ConfigError: none of these.
    """
    if words == EVEN:
        return Light(EVEN, None)
    if words == ESTIMATED:
        own = avatar.key_light
        return Light(EVEN, None) if own is None else Light(ESTIMATED, upright[:3, :3] @ own.cpu())
    try:
        azimuth, height = (math.radians(float(word)) for word in words.split(","))
        if not (math.isfinite(azimuth) and math.isfinite(height)):
            raise ValueError
    except ValueError:
        raise ConfigError(
            f"--light {words}: even, estimated, or the lamp's direction as AZIMUTH,HEIGHT in degrees, such as 45,30"
        ) from None
    flat = math.cos(height)
    direction = torch.tensor([flat * math.sin(azimuth), math.sin(height), flat * math.cos(azimuth)])
    return Light("lamp", LAMP_STRENGTH * direction)


@dataclass(frozen=True)
class Layers:
    """What was drawn of one shot.

    Attributes:
        rgb: over black, not divided by alpha, `[H, W, 3]`.
        alpha: `[H, W]`.
        depth: metres along the optical axis, 0 where there is nothing, `[H, W]`.
        normals: camera axes x right, y up, z towards the viewer, unit length, 0 where there is nothing, `[H, W, 3]`;
            None where nobody asked.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    normals: Tensor | None


class Painter:
    """Draws one avatar's performance.

    Args:
        avatar: whose lamp is replaced.
        performance: its motion.
        light: to show it in.
        renderer: draws.
    """

    def __init__(self, avatar: Avatar, performance: Performance, light: Light, renderer: Renderer) -> None:
        self.avatar = avatar
        self.performance = performance
        self._renderer = renderer
        avatar.relight(None if light.vector is None else performance.upright[:3, :3].T @ light.vector)

    @torch.inference_mode()
    def draw(self, shot: Shot, *, normals: bool = False) -> Layers:
        """Returns the layers of a shot.

        Raises:
            ConfigError: the camera is within the body.
        """
        cloud = self.cloud(shot)
        self._check_outside(shot, cloud)
        drawn = self._renderer.draw(cloud, shot.camera)
        found = self._normals(shot, cloud) if normals else None
        return Layers(drawn.rgb, drawn.alpha, drawn.depth, found)

    @torch.inference_mode()
    def cloud(self, shot: Shot) -> Cloud:
        """Returns the Gaussians of a shot, with the footprint that fits its size."""
        centre = shot.camera.centre
        if shot.row is None:
            cloud = self.avatar.canonical(centre)
        else:
            cloud = self.avatar(self.performance.pose(shot.row), centre)
        return replace(cloud, dilation=footprint(cloud.dilation, shot.scale))

    def _normals(self, shot: Shot, cloud: Cloud) -> Tensor:
        avatar = self.avatar
        if shot.row is None:
            own = avatar.da_normals[avatar.gaussians.vertex_index]
        else:
            own = avatar.surface_normals(avatar.deform(self.performance.pose(shot.row))).T
        own = functional.normalize(own, dim=1, eps=SHORTEST)
        seen = own @ shot.camera.viewmat[:3, :3].T.to(own) * own.new_tensor([1.0, -1.0, -1.0])
        # of a thin place, such as an inner lip, the side that is seen is the one that looks at the camera
        seen = torch.where(seen[:, 2:] < 0.0, -seen, seen)
        # colours have no sign: half of each goes through the rasteriser
        drawn: Rendering = self._renderer.draw(replace(cloud, colors=0.5 * seen + 0.5), shot.camera)
        signed = 2.0 * drawn.rgb - drawn.alpha[..., None]
        return functional.normalize(signed, dim=-1, eps=1e-6) * (drawn.alpha > 0.0)[..., None]

    def _check_outside(self, shot: Shot, cloud: Cloud) -> None:
        if self._is_within(shot, cloud):
            which = f' "{shot.caption}"' if shot.caption else ""
            when = "in the canonical pose" if shot.row is None else f"at frame {shot.row} of the motion"
            raise ConfigError(
                f"the camera{which} is within the body {when}; move it away from the person, or name another --path"
            )

    def _is_within(self, shot: Shot, cloud: Cloud) -> bool:
        eye, reach = shot.camera.centre.to(cloud.means), 0.05
        low, high = cloud.means.amin(dim=0) - reach, cloud.means.amax(dim=0) + reach
        if bool(((eye < low) | (eye > high)).any()):
            return False
        if bool((cloud.means - eye).square().sum(dim=1).amin().sqrt() < _INSIDE):
            return True
        avatar = self.avatar
        if shot.row is None:
            vertices = avatar.da_vertices
        else:
            pose = self.performance.pose(shot.row)
            vertices = avatar.body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)[0]
        faces = avatar.body.faces.cpu().numpy()
        return abs(winding_number(eye.cpu().numpy(), vertices.cpu().numpy(), faces)) > 0.5


def footprint(dilation: float, scale: float) -> float:
    """Returns the dilation that pictures of another size have, square pixels.

    The footprint that Gaussians were learned with belongs to the person: it grows with the picture. Where pictures
    are smaller, what their larger pixels average over comes to it.

    Args:
        dilation: learned with, square pixels of the training pictures.
        scale: pixels of the picture to one of the training pictures.
    """
    return dilation * scale**2 + BOX_VARIANCE * max(0.0, 1.0 - scale**2)


def world_to_clip(own: Performance, shown: Performance) -> Tensor:
    """Returns the rigid map from the world of an avatar's own sequence to that of the clip it performs, `[4, 4]`."""
    return torch.linalg.inv(shown.upright.double()).float() @ own.upright
