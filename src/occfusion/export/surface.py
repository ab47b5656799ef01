"""The avatar's surface as a mesh: the body's triangles, moved to where the Gaussians end, coloured by pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from occfusion.geometry.camera import look_at
from occfusion.geometry.neighbours import nearest
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.rotation import quaternion_to_matrix
from occfusion.geometry.skinning import blend, bone_transforms, invert_affine, skin_points
from occfusion.human import Avatar
from occfusion.human.deform import skinning_weights
from occfusion.human.rendering import Renderer
from occfusion.motion import Performance
from occfusion.splat import Limits
from occfusion.splat.harmonics import COLOR_OFFSET, SH_C0
from occfusion.types import Camera

SIZE = 768
"""Of the pictures that colours and depths are taken from, pixels."""
RINGS = ((-0.6, 6), (0.0, 10), (0.6, 6), (1.35, 2))
"""Cameras around the canonical pose: elevation in radians, and how many."""
NEIGHBOURS, SMOOTHINGS = 24, 3
"""Gaussians that say where a vertex goes, and rounds of smoothing."""
FARTHEST, SAMPLES = 0.05, 51
"""Metres along its normal that a vertex goes at most, and how many places there are tried."""
EDGE = 0.06
"""Sum of the Gaussians' opacities at the surface; outlines of mesh and pictures agree best so."""
_FAINT = -20.0
"""Exponent from which on a Gaussian is nothing; smaller ones would make numbers that processors are slow with."""
_HIDDEN = 0.02
"""Metres behind what a camera sees first from which on a vertex is hidden from it."""


@dataclass(frozen=True)
class Surface:
    """A mesh that follows the bones.

    Attributes:
        rest: vertices of this person at rest, `[V, 3]`, metres.
        faces: `[F, 3]`.
        weights: skinning weights, `[V, 24]`, rows sum to 1.
        colors: of even light, `[V, 3]`, 0 to 1 as pictures have them.
    """

    rest: Tensor
    faces: NDArray[np.int64]
    weights: Tensor
    colors: Tensor

    @torch.no_grad()
    def posed(self, avatar: Avatar, performance: Performance, row: int) -> Tensor:
        """Returns the vertices in a frame of a motion, upright frame, `[V, 3]`."""
        rotations, transl = avatar._corrected(performance.pose(row))
        joints = avatar.body.rest(performance.betas).joints
        maps = blend(self.weights, bone_transforms(rotations, joints, avatar.body.parents))
        turn, shift = performance.upright[:3, :3], performance.upright[:3, 3]
        return (skin_points(self.rest, maps) + transl) @ turn.T + shift


@torch.no_grad()
def find_surface(avatar: Avatar, betas: Tensor, renderer: Renderer) -> Surface:
    """Returns the surface of an avatar, its triangles four times as many as the body's.

    Each vertex goes along its normal to where the Gaussians around it lie. Its colour is what pictures around the
    canonical pose show there. Blend shapes of a pose are left out.

    Args:
        avatar: whose; it is drawn in even light.
        betas: shape of the person, `[B]`.
        renderer: draws.
    """
    body = avatar.body
    shape = body.shapedirs[:, :, : len(betas)] @ betas
    attributes = {"weights": body.weights.numpy(), "shape": shape.numpy()}
    import trimesh

    vertices, faces, finer = trimesh.remesh.subdivide(
        avatar.da_vertices.numpy(), body.faces.numpy(), vertex_attributes=attributes
    )
    points, weights = torch.tensor(vertices).float(), torch.tensor(finer["weights"]).float()
    points = points + _offsets(avatar, points, faces)[:, None] * _normals(points, faces)
    colors = _colors(avatar, _views(avatar, renderer, points), points, _normals(points, faces))
    if avatar.skinning_field is not None:
        weights = skinning_weights(weights, avatar.skinning_field(points))
    back = invert_affine(blend(weights, avatar.da_transforms))
    rest = skin_points(points, back) + torch.tensor(finer["shape"]).float()
    return Surface(rest, np.asarray(faces, np.int64), weights, colors)


def _offsets(avatar: Avatar, points: Tensor, faces: NDArray[np.integer]) -> Tensor:
    """Returns how far along its normal from each vertex the Gaussians around it end, `[V]`, metres."""
    gaussians, normals = avatar.gaussians, _normals(points, faces)
    found = nearest(points, gaussians.means, min(NEIGHBOURS, gaussians.num_gaussians)).indices
    own = avatar.da_normals[gaussians.vertex_index][found]
    opacities = gaussians.opacities[found] * ((own * normals[:, None]).sum(dim=2) > 0.0)
    # lengths are standard deviations in the axes of each Gaussian
    unit = (quaternion_to_matrix(gaussians.raw_quats) / gaussians.scales.unsqueeze(-2)).transpose(1, 2)[found]
    start = (unit @ (points[:, None] - gaussians.means[found]).unsqueeze(-1)).squeeze(-1)
    step = (unit @ normals[:, None, :, None]).squeeze(-1)
    # its square is a parabola along the normal
    square, mixed, steep = start.square().sum(dim=2), (start * step).sum(dim=2), step.square().sum(dim=2)
    reached, offsets = torch.zeros(len(points), dtype=torch.bool), torch.zeros(len(points))
    for away in torch.linspace(FARTHEST, -FARTHEST, SAMPLES).tolist():  # from outside
        exponents = -0.5 * (square + 2.0 * away * mixed + away**2 * steep)
        density = (opacities * exponents.clamp_min_(_FAINT).exp_()).sum(dim=1)
        offsets[(density > EDGE) & ~reached] = away
        reached |= density > EDGE
    return _averaged(offsets, faces)


def _colors(avatar: Avatar, views: list[_View], points: Tensor, normals: Tensor) -> Tensor:
    total, weight = torch.zeros(len(points), 3), torch.zeros(len(points), 1)
    for view in views:
        facing, behind, rgb, inside = view.look(points, normals)
        share = torch.where(inside & (behind < _HIDDEN), facing.clamp_min(0.0) ** 4, 0.0)[:, None]
        total, weight = total + share * rgb, weight + share
    own = (
        avatar.gaussians.sh0[nearest(points, avatar.gaussians.means).indices[:, 0], 0] * SH_C0 + COLOR_OFFSET
    )
    # the nearest Gaussian counts where hardly a camera sees
    return ((total + 0.02 * own) / (weight + 0.02)).clamp(0.0, 1.0)


@dataclass(frozen=True)
class _View:
    camera: Camera
    rgb: Tensor
    alpha: Tensor
    depth: Tensor

    def look(self, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns of each point the cosine to the camera, metres behind what is seen, its colour, and whether."""
        camera = self.camera
        seen = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        place = 2.0 * (seen[:, :2] / seen[:, 2:] * camera.K[0, 0] + camera.K[0, 2]) / SIZE - 1.0
        layers = torch.cat(
            [self.rgb, self.alpha[..., None], self.depth[..., None] * self.alpha[..., None]], dim=2
        )
        taken = functional.grid_sample(
            layers.permute(2, 0, 1)[None], place[None, None], mode="bilinear", align_corners=False
        )[0, :, 0].T
        alpha = taken[:, 3].clamp_min(1e-6)
        ray = functional.normalize(camera.centre - points, dim=1)
        behind = (seen[:, 2] - taken[:, 4] / alpha) * (camera.centre - points).norm(dim=1) / seen[:, 2]
        return (normals * ray).sum(dim=1), behind, taken[:, :3] / alpha[:, None], taken[:, 3] > 0.5


def _views(avatar: Avatar, renderer: Renderer, points: Tensor) -> list[_View]:
    low, high = points.amin(dim=0), points.amax(dim=0)
    middle, reach = 0.5 * (low + high), float((high - low).norm()) / 2
    distance = 3.0 * reach
    focal = 0.5 * SIZE / math.tan(math.asin(1.02 * reach / distance))
    K = torch.tensor([[focal, 0.0, SIZE / 2], [0.0, focal, SIZE / 2], [0.0, 0.0, 1.0]])
    avatar.relight(None)
    views = []
    for rise, count in RINGS:
        for k in range(count):
            angle = 2 * math.pi * (k + 0.5) / count
            flat = math.cos(rise)
            way = torch.tensor([flat * math.sin(angle), math.sin(rise), flat * math.cos(angle)])
            eye = middle + distance * way
            camera = Camera(look_at(eye, middle, torch.tensor([0.0, 1.0, 0.0])), K, SIZE, SIZE)
            # wide enough that no picture has holes between Gaussians
            cloud = replace(avatar.canonical(eye), dilation=max(avatar.dilation, Limits.dilation))
            drawn = renderer.draw(cloud, camera)
            views.append(_View(camera, drawn.rgb, drawn.alpha, drawn.depth))
    return views


def _normals(points: Tensor, faces: NDArray[np.integer]) -> Tensor:
    return torch.from_numpy(vertex_normals(points.double().numpy(), faces)).float()


def _averaged(values: Tensor, faces: NDArray[np.integer]) -> Tensor:
    """Returns the values of vertices `[V]`, `SMOOTHINGS` times averaged with those of their neighbours."""
    ends = torch.from_numpy(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]))
    count = torch.ones_like(values).index_add(0, ends[:, 0], torch.ones(len(ends)))
    for _ in range(SMOOTHINGS):
        values = values.index_add(0, ends[:, 0], values[ends[:, 1]]) / count
    return values
