"""How Gaussians hang on the body's bones."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from occfusion.geometry.skinning import blend, invert_affine


class Binding(NamedTuple):
    """What ties each Gaussian to the bones.

    Attributes:
        weights: skinning weights, `[N, 24]`, rows sum to 1.
        rest_maps: affine maps from the canonical Da pose to rest, `[3, 4, N]`.
    """

    weights: Tensor
    rest_maps: Tensor


def bind(weights: Tensor, da_transforms: Tensor) -> Binding:
    """Returns the binding of Gaussians with `weights [N, 24]` that live in the Da pose.

    The way back to rest is the inverse of the blended Da transform, as in GauHuman. The sum over joints of
    `w_k G_k D_k^-1` would need no inverse, but it is another deformation: at a hip of equal weights it
    shrinks the body by 15 %, while with the inverse a Gaussian on a vertex of the canonical body lies on that
    vertex in every pose. For the Da pose the inverse is harmless whatever the weights (`body.DA_POSE`).
    """
    return Binding(weights, invert_affine(blend(weights, da_transforms)).permute(1, 2, 0).contiguous())
