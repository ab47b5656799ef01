"""How Gaussians keep to the dressed body where a video says nothing of their depth: bounds."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from occfusion.geometry.rotation import quaternion_to_matrix
from occfusion.human.gaussians import Gaussians

OUTWARDS, INWARDS = 0.005, 0.015
"""Metres that a Gaussian may stand outside of clothes, and inside the body, where nothing is known of its depth."""
THICK, LONG = 0.002, 0.006
"""Standard deviation that it may have there across the surface, and along the direction of which nothing is known;
vertices of a body are about 0.017 m apart."""
WIDE = 0.75
"""Share of `KnownSurface.sizes` that a Gaussian may have there in any direction: large ones on curved places are a
blurred outline from the side, and a blurred pattern."""
HELD_FROM = 0.2
"""Ignorance from which on a Gaussian is bounded."""
LEAST_COSINE = 1e-3
"""Between an axis of a Gaussian and a direction that it is bounded along: those at right angles are not."""


@dataclass(frozen=True)
class KnownSurface:
    """A canonical body's surface and what is known of it, by vertex.

    Attributes:
        vertices: `[V, 3]`, metres.
        normals: `[V, 3]`, of length 1.
        thickness: of the clothes, `[V]`, metres, not negative.
        axis: the direction of which least is known, `[V, 3]`, of length 1.
        ignorance: how little, `[V]`, 0 to 1.
        sizes: standard deviation that Gaussians on the clothes would begin with there, `[V]`, metres.
    """

    vertices: Tensor
    normals: Tensor
    thickness: Tensor
    axis: Tensor
    ignorance: Tensor
    sizes: Tensor


@torch.no_grad()
def hold(gaussians: Gaussians, surface: KnownSurface, *, compiled: bool = True) -> None:
    """Brings Gaussians back that left the room that the video gives them; changes them in place.

    A penalty that is weighed against colours is paid by those that a wrong pose pulls hardest. Bounds are not: in
    units of what is allowed where nothing is known, the room grows as the ignorance falls.

    Args:
        gaussians: canonical.
        surface: of the body that they are held to.
        compiled: by the kernels of `surface_bounds_kernels.py`, of which this is the specification, where they take the
            Gaussians: float32 on a CPU.
    """
    if compiled and _are_taken(gaussians):
        # numba is loaded where it is used
        from occfusion.human import surface_bounds_kernels

        surface_bounds_kernels.hold(gaussians, surface)
        increment_version([gaussians.means, gaussians.log_scales])  # what is kept of them is asked for anew
        return
    held = (surface.ignorance[gaussians.vertex_index] >= HELD_FROM).nonzero()[:, 0]
    rows = gaussians.vertex_index[held]
    room, normal, axis = 1.0 / surface.ignorance[rows], surface.normals[rows], surface.axis[rows]
    means = gaussians.means[held]
    height = ((means - surface.vertices[rows]) * normal).sum(dim=1)
    allowed = height.clamp(min=-INWARDS * room, max=surface.thickness[rows] + OUTWARDS * room)
    gaussians.means[held] = means + (allowed - height)[:, None] * normal
    turns = quaternion_to_matrix(gaussians.raw_quats[held])
    across, along = (
        (turns * direction[:, :, None]).sum(dim=1).abs().clamp(min=LEAST_COSINE)
        for direction in (normal, axis)
    )
    widest = WIDE * surface.sizes[rows, None]
    longest = room[:, None] * torch.minimum(torch.minimum(THICK / across, LONG / along), widest)
    gaussians.log_scales[held] = torch.minimum(gaussians.log_scales[held], longest.log())


def _are_taken(gaussians: Gaussians) -> bool:
    return gaussians.means.dtype == torch.float32 and gaussians.means.device.type == "cpu"
