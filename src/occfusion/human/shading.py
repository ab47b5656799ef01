"""Colours of posed Gaussians: what harmonics give from a place, and how bright a key light makes a surface.

The paper has no light: its colours turn with the limbs, and what a lamp does to them as a person turns is put down to
the viewing direction, which for one camera comes to the same and for any other does not.
"""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional

from occfusion.human.gaussians import Gaussians
from occfusion.splat.harmonics import evaluate

_TOUCHING = 1e-6
"""Metres; a Gaussian nearer to the camera has no direction to be seen from, and is not drawn anyway."""

SHORTEST = 1e-8
"""Normals shorter than this have no direction."""


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
    squared = directions.square().sum(dim=0).clamp(min=_TOUCHING**2)
    return evaluate(gaussians.sh(degree), (directions * squared.rsqrt()).T, degree)
