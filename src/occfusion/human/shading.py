"""Colours of posed Gaussians: what harmonics give from a place, and how bright a key light makes a surface.

The paper has no light: its colours turn with the limbs, and what a lamp does to them as a person turns is put down to
the viewing direction, which for one camera comes to the same and for any other does not.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from occfusion.human.carry import Carried
from occfusion.human.gaussians import Gaussians
from occfusion.splat.harmonics import evaluate

HIGHEST_COMPILED = 1
"""Band up to which colours are computed by the kernels of `color_kernels.py`."""

TOUCHING = 1e-6
"""Metres; a Gaussian nearer to the camera has no direction to be seen from, and is not drawn anyway."""

SHORTEST = 1e-8
"""Normals shorter than this have no direction."""


def posed_colors(
    gaussians: Gaussians,
    degree: int,
    carried: Carried,
    camera_centre: Tensor,
    normals: Tensor,
    key_light: Tensor | None,
    *,
    compiled: bool = True,
) -> Tensor:
    """Returns the colours of posed Gaussians from a camera, `[N, 3]`: `seen_colors` times `brightness`.

    Viewing directions are turned back with each Gaussian, so that colours turn with the limbs. A Gaussian faces where
    the body does at its vertex; poses are not mended by light, which is without gradient.

    Args:
        gaussians: whose harmonics.
        degree: highest band in use.
        carried: where they are.
        camera_centre: `[3]`, metres.
        normals: of the canonical body's vertices, `[V, 3]`.
        key_light: see `brightness`; None: even light.
        compiled: by the kernels of `color_kernels.py`, of which this is the specification, where they take the
            Gaussians: float32 on a CPU, bands 0 and 1.
    """
    means = carried.means
    is_plain = means.dtype == torch.float32 and means.device.type == "cpu"
    if compiled and is_plain and degree <= HIGHEST_COMPILED:
        # numba is loaded where it is used
        from occfusion.human import color_kernels

        lamp = means.new_empty(0) if key_light is None else key_light
        colors: Tensor = color_kernels.PosedColors.apply(
            gaussians.sh0, gaussians.sh_rest, means, carried.linear, camera_centre.to(means), normals,
            gaussians.vertex_index, lamp, degree,
        )  # fmt: skip
        return colors
    colors = seen_colors(gaussians, degree, means, camera_centre, carried.linear)
    if key_light is None:
        return colors
    return colors * brightness(surface_normals(gaussians, carried, normals), key_light)[:, None]


def surface_normals(gaussians: Gaussians, carried: Carried, normals: Tensor) -> Tensor:
    """Returns the body's normals at posed Gaussians, `[3, N]`, world, of any length, without gradient.

    Args:
        gaussians: on the body.
        carried: where they are.
        normals: of the canonical body's vertices, `[V, 3]`.
    """
    own = normals[gaussians.vertex_index].T
    return (carried.linear.detach() * own).sum(dim=1)


def brightness(normals: Tensor, key_light: Tensor) -> Tensor:
    """Returns the brightness of surfaces, `[N]`, 1 in the mean over all directions.

    Lambert's law: even light of 1 gives 1, a far lamp adds its strength times the cosine to the normal.

    Args:
        normals: in the world, `[3, N]`, of any length.
        key_light: towards the lamp, as long as it is strong beside the even light, `[3]`.
    """
    facing = key_light @ functional.normalize(normals, dim=0, eps=SHORTEST)
    # a cosine clamped at 0 is a quarter in the mean over the sphere
    return (1.0 + facing.clamp_min(0.0)) / (1.0 + 0.25 * key_light.norm())


def seen_colors(
    gaussians: Gaussians, degree: int, means: Tensor, camera_centre: Tensor, turned: Tensor | None
) -> Tensor:
    """Returns the colours of Gaussians from a camera, `[N, 3]`, under even light.

    Args:
        gaussians: whose harmonics.
        degree: highest band in use.
        means: where they are, `[N, 3]`, metres.
        camera_centre: `[3]`, metres.
        turned: the turns that directions are taken back by, `[3, 3, N]`; None: none.
    """
    if degree == 0:
        return evaluate(gaussians.sh0, means.detach(), 0)  # the same from everywhere
    directions = (means - camera_centre.to(means)).T
    if turned is not None:
        # the transpose undoes the turn; what a blend of turns stretches is taken out below
        x, y, z = directions
        directions = turned[0] * x + turned[1] * y + turned[2] * z
    squared = directions.square().sum(dim=0).clamp(min=TOUCHING**2)
    return evaluate(gaussians.sh(degree), (directions * squared.rsqrt()).T, degree)
