"""How Gaussians hang on the bones, and what the avatar learns of that: GauHuman's two networks."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from occfusion.files.bodyfile import NUM_JOINTS
from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.geometry.skinning import blend, invert_affine

_BODY_ANGLES = 3 * (NUM_JOINTS - 1)

_LAST_LAYER = 1e-5
"""Bound of the last layer's uniform start: corrections begin at practically none."""

_WEIGHT_FLOOR = 1e-9
"""Added to the body's weights before the logarithm, so that weight 0 can be learned away from."""


class PoseRefiner(nn.Module):
    """Corrections of the 23 body rotations from the body pose itself; the root is left as given."""

    def __init__(self, width: int = 128) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(_BODY_ANGLES, width), nn.ReLU(),
            nn.Linear(width, width), nn.ReLU(),
            nn.Linear(width, _BODY_ANGLES),
        )  # fmt: skip
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.uniform_(last.weight, -_LAST_LAYER, _LAST_LAYER)
        nn.init.uniform_(last.bias, -_LAST_LAYER, _LAST_LAYER)

    def corrections(self, body_pose: Tensor) -> Tensor:
        """Returns the corrections of the 23 joints as axis-angles `[23, 3]`, radians, for a body pose `[69]`."""
        angles: Tensor = self.layers(body_pose)
        return angles.unflatten(-1, (NUM_JOINTS - 1, 3))

    def forward(self, body_pose: Tensor, rotations: Tensor) -> Tensor:
        """Returns the joint rotations `[24, 3, 3]` with corrections multiplied from the right.

        Args:
            body_pose: axis-angles, `[69]`, radians: what the network sees.
            rotations: joint rotations as the data give them, `[24, 3, 3]`; on the host or where the network is, and
                so is what comes back.
        """
        angles = self.corrections(body_pose.to(next(self.parameters())))
        corrections = axis_angle_to_matrix(angles.to(rotations), compiled=True)
        return torch.cat([rotations[:1], rotations[1:] @ corrections])


class SkinningField(nn.Module):
    """Offsets to the logarithms of skinning weights, as a function of the place in canonical space."""

    def __init__(self, frequencies: int = 10, width: int = 128) -> None:
        super().__init__()
        self.frequencies = frequencies
        encoded = 3 + 6 * frequencies
        self.first = nn.Linear(encoded, width)
        self.second = nn.Linear(width, width)
        self.third = nn.Linear(width + encoded, width)  # the encoding is given once more: the skip
        self.fourth = nn.Linear(width, width)
        self.last = nn.Linear(width, NUM_JOINTS)
        nn.init.uniform_(self.last.weight, -_LAST_LAYER, _LAST_LAYER)
        nn.init.uniform_(self.last.bias, -_LAST_LAYER, _LAST_LAYER)

    def forward(self, means: Tensor) -> Tensor:
        """Returns offsets `[N, 24]` for canonical places `[N, 3]` in metres."""
        encoded = encode_positions(means, self.frequencies)
        hidden = functional.relu(self.first(encoded))
        hidden = functional.relu(self.second(hidden))
        hidden = functional.relu(self.third(torch.cat([encoded, hidden], dim=-1)))
        hidden = functional.relu(self.fourth(hidden))
        return self.last(hidden)


def encode_positions(positions: Tensor, frequencies: int) -> Tensor:
    """Returns positions `[N, 3]`, then sines and cosines of 2^0, 2^1, ... times them, `[N, 3 + 6 F]`."""
    octaves = torch.exp2(torch.arange(frequencies, dtype=positions.dtype, device=positions.device))
    phases = (positions.unsqueeze(-2) * octaves.unsqueeze(-1)).flatten(-2)
    return torch.cat([positions, phases.sin(), phases.cos()], dim=-1)


def skinning_weights(body_weights: Tensor, offsets: Tensor) -> Tensor:
    """Returns weights `[N, 24]`: softmax of the body's log-weights plus offsets; rows sum to 1.

    Args:
        body_weights: weights of each Gaussian's body vertex, `[N, 24]`.
        offsets: what `SkinningField` gives, `[N, 24]`.
    """
    return torch.softmax((body_weights + _WEIGHT_FLOOR).log() + offsets, dim=-1)


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
