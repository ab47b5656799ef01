"""How Gaussians hang on the body's bones, and how a bone pose carries them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from occfusion.geometry.skinning import blend, invert_affine


class Binding(NamedTuple):
    """What ties each Gaussian to the bones.

    Attributes:
        weights: skinning weights, `[N, 24]`, rows sum to 1.
        rest_maps: affine maps from the canonical Da pose to rest, `[N, 3, 4]`.
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
    return Binding(weights, invert_affine(blend(weights, da_transforms)))


class Carried(NamedTuple):
    """Gaussians carried into a pose.

    Attributes:
        means: centres, `[N, 3]`, metres.
        roots: roots of the covariances, `[N, 3, 3]`, metres: the covariance is root times its transpose.
        linear: linear part of the whole deformation, `[N, 3, 3]`.
    """

    means: Tensor
    roots: Tensor
    linear: Tensor


def carry(means: Tensor, roots: Tensor, binding: Binding, offsets: Tensor, transforms: Tensor) -> Carried:
    """Returns Gaussians moved from the canonical to a posed body (paper §3.1, with covariances T S T^t).

    Args:
        means: canonical centres, `[N, 3]`, metres.
        roots: canonical roots of the covariances, `[N, 3, 3]`.
        binding: see `bind`.
        offsets: blend shapes of the target body minus those of the canonical one, `[N, 3]`, metres, at rest.
        transforms: bone transforms of the target pose, `[24, 4, 4]`.
    """
    posed_maps = blend(binding.weights, transforms)
    rest_linear, posed_linear = binding.rest_maps[:, :, :3], posed_maps[:, :, :3]
    rest_means = torch.baddbmm(binding.rest_maps[:, :, 3:], rest_linear, means.unsqueeze(-1))
    rest_means = rest_means + offsets.unsqueeze(-1)
    posed_means = torch.baddbmm(posed_maps[:, :, 3:], posed_linear, rest_means)
    linear = posed_linear @ rest_linear
    return Carried(posed_means.squeeze(-1), linear @ roots, linear)
