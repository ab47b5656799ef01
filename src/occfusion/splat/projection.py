"""Gaussians in space to splats on the picture: cull, project, dilate, bound.

EWA splatting (Zwicker et al. 2001, eq. 24-31) with the local affine approximation of 3DGS. The
quadratic form of a splat is kept as a triangular factor: with d = pixel - centre,

    u = l1 dx + m dy,   v = l2 dy,   alpha = opacity * exp(-(u**2 + v**2) / 2),

a sum of squares, which does not cancel for needles as A dx^2 + 2 B dx dy + C dy^2 does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from occfusion.splat.limits import COMPENSATION_FLOOR, FRUSTUM_MARGIN, QUATERNION_FLOOR
from occfusion.splat.request import Request


@dataclass(frozen=True)
class Splats:
    """The Gaussians that can be seen, projected.

    Attributes:
        index: their rows in the input, `[V]`.
        means2d: centres in pixels of the full picture, float64 `[V, 2]`: a rounding of a large coordinate would
            move the splat, and with it who is dropped, by more than all others together.
        factors: `l1, m, l2` of the quadratic form, `[V, 3]`, 1/pixels.
        opacities: `[V]`, with the anti-aliasing compensation when asked.
        depths: camera z, `[V]`, metres.
        extents: half width and height of the box outside which alpha < alpha_min, `[V, 2]`, pixels.
        exact_depths: camera z in double precision without gradient, `[V]`: what the order goes by, since
            two splats that rounding exchanges change the gradients of all pixels under both.
    """

    index: Tensor
    means2d: Tensor
    factors: Tensor
    opacities: Tensor
    depths: Tensor
    extents: Tensor
    exact_depths: Tensor


def project(request: Request) -> Splats:
    """Returns the splats that touch the crop, differentiable in every input of the request.

    Where some reach no pixel of the crop they are left out before anything is kept for the gradient: nothing that
    was divided by a depth of zero, or grew beyond all numbers, is part of the graph.
    """
    with torch.no_grad():
        depths = request.means @ request.viewmat[2, :3] + request.viewmat[2, 3]
        index = (depths > request.near).nonzero().squeeze(1)
    candidates = _project_rows(request, index)
    seen = touches(candidates, request.crop)
    return candidates if bool(seen.all()) else _project_rows(request, index[seen])


@torch.no_grad()
def touches(splats: Splats, crop: tuple[int, int, int, int]) -> Tensor:
    """Returns which splats reach a pixel centre of the crop with alpha >= alpha_min, bool `[V]`."""
    x, y, width, height = crop
    low = splats.means2d - splats.extents
    high = splats.means2d + splats.extents
    first = low.new_tensor([x + 0.5, y + 0.5])
    last = low.new_tensor([x + width - 0.5, y + height - 0.5])
    overlaps = ((high >= first) & (low <= last)).all(-1)
    return overlaps & (splats.extents > 0).all(-1) & splats.means2d.isfinite().all(-1)


def _project_rows(request: Request, index: Tensor) -> Splats:
    """Returns the splats of Gaussians known to lie beyond the near plane.

    The geometry is done in float64: there are far fewer Gaussians than pixels, and the only roundings left
    are those of the inputs and of the result.
    """
    dtype = request.means.dtype
    request = request.rows(index).in_double()
    fx, fy, cx, cy = request.intrinsics
    rotation, translation = request.viewmat[:3, :3], request.viewmat[:3, 3]
    x, y, z = (request.means @ rotation.T + translation).unbind(-1)
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)
    if request.screen_offsets is not None:
        means2d = means2d + request.screen_offsets
    a, b, c, flat_det = _plane_covariance(request, _affine_rows(request, x, y, z))
    eps = request.limits.dilation
    det = flat_det + eps * (a + c) + eps * eps  # every term is positive: nothing cancels
    a, c = a + eps, c + eps
    factors = torch.stack([(c / det).sqrt(), -b / (c * det).sqrt(), c.rsqrt()], dim=-1)
    opacities = request.opacities
    if request.antialiased:
        opacities = opacities * (flat_det / det).clamp_min(COMPENSATION_FLOOR).sqrt()
    extents = _extents(a, c, opacities, request.limits.alpha_min)
    return Splats(
        index, means2d, factors.to(dtype), opacities.to(dtype), z.to(dtype), extents.to(dtype), z.detach()
    )


def _affine_rows(request: Request, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Returns the Jacobian of the projection times the view rotation, `[V, 2, 3]`, pixels a metre.

    The point at which the projection is linearised is clamped to the picture plus a margin on each
    side of it, so the form is exact for off-centre principal points too.
    """
    fx, fy, cx, cy = request.intrinsics
    margin_x = FRUSTUM_MARGIN * 0.5 * request.width / fx
    margin_y = FRUSTUM_MARGIN * 0.5 * request.height / fy
    slope_x = (x / z).clamp(-cx / fx - margin_x, (request.width - cx) / fx + margin_x)
    slope_y = (y / z).clamp(-cy / fy - margin_y, (request.height - cy) / fy + margin_y)
    right, down, forward = request.viewmat[:3, :3].unbind(0)
    row_x = (fx / z)[:, None] * (right - slope_x[:, None] * forward)
    row_y = (fy / z)[:, None] * (down - slope_y[:, None] * forward)
    return torch.stack([row_x, row_y], dim=1)


def _plane_covariance(request: Request, affine: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns entries a, b, c of the projected covariance and its determinant, each float64 `[V]`.

    From rotation and scales the determinant is the squared cross product of the two rows of the
    projected square root, never a difference of large numbers. A covariance has lost its square
    root: there all that can be done is to lose nothing further. Float64 also keeps the fourth powers
    of the largest splats finite.
    """
    if request.covariances is not None:
        covariance = request.covariances
        covariance = 0.5 * (covariance + covariance.transpose(1, 2))
        plane = affine @ covariance @ affine.transpose(1, 2)
        a, b, c = plane[:, 0, 0], 0.5 * (plane[:, 0, 1] + plane[:, 1, 0]), plane[:, 1, 1]
        return a.clamp_min(0), b, c.clamp_min(0), (a * c - b * b).clamp_min(0)
    assert request.quats is not None and request.scales is not None
    root = affine @ rotation_matrices(request.quats) * request.scales[:, None, :]
    row_x, row_y = root.unbind(1)
    cross = torch.linalg.cross(row_x, row_y)
    return (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1), (cross * cross).sum(-1)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Returns rotation matrices `[V, 3, 3]` of quaternions `[V, 4]` (w, x, y, z) of any norm.

    Dividing by the largest component first keeps 1e-10 and 1e20 from under- and overflowing; below
    `QUATERNION_FLOOR` the rotation is the identity.
    """
    largest = quats.detach().abs().amax(-1, keepdim=True)
    is_rotation = largest >= QUATERNION_FLOOR
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    scaled = torch.where(is_rotation, quats / torch.where(is_rotation, largest, 1.0), identity)
    w, x, y, z = (scaled / scaled.norm(dim=-1, keepdim=True)).unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


@torch.no_grad()
def _extents(a: Tensor, c: Tensor, opacities: Tensor, alpha_min: float) -> Tensor:
    """Returns the exact half extents of the region where alpha >= alpha_min, `[V, 2]` pixels.

    opacity * exp(-q / 2) = alpha_min at q = 2 ln(opacity / alpha_min); the ellipse q reaches
    sqrt(q a) and sqrt(q c) along the axes. Zero where the opacity itself is below alpha_min.
    """
    q = 2 * (opacities.clamp_min(1e-300).log() - math.log(alpha_min)).clamp_min(0)
    return torch.stack([(q * a).sqrt(), (q * c).sqrt()], dim=-1)
