"""The canonical Gaussians: parameters, their activations and their start on the body (paper §3.2)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from occfusion.geometry.neighbours import nearest, nearest_others
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.rotation import normalize_quaternion, quaternion_to_matrix, z_axis_to
from occfusion.human.body import Body

MIN_SCALE, MAX_SCALE = 1e-5, 0.5
"""Bounds on standard deviations in metres: from a hair's tenth to a torso. Outside, nothing of a person is
drawn, and exponentials head for overflow."""

WIDEST = 0.05
"""Bound on standard deviations in metres while training: what grows wider is a needle that one camera sees from its
end, and all others as a streak across the picture."""

MAX_LOGIT = 12.0
"""Bound on opacity logits: past it the sigmoid of float32 stops having a useful gradient."""

INITIAL_OPACITY = 0.1
INITIAL_NEIGHBOURS = 3
"""Neighbours whose mean squared distance gives a Gaussian's first size (3DGS)."""

_NORM_RANGE = (0.5, 2.0)
"""Quaternions are brought back to length 1 when they leave this range; inside, Adam's steps suit them as they
are.
"""

MEANS_HORIZON = 30_000
"""Steps over which 3DGS lowers the learning rate of the means, whatever the length of the training."""

PARAMETERS = ("means", "raw_quats", "log_scales", "opacity_logits", "sh0", "sh_rest")
"""Names of the parameters; each has one row a Gaussian."""

GROUPS = {
    "means": "means",
    "sh0": "sh0",
    "sh_rest": "sh_rest",
    "opacity": "opacity_logits",
    "scales": "log_scales",
    "quats": "raw_quats",
}
"""Optimiser groups, by the name of the parameter in each."""


class Gaussians(nn.Module):
    """Canonical Gaussians, one row each in every parameter.

    Args:
        means: centres in the Da pose of the mean-shape body, `[N, 3]`, metres.
        scales: standard deviations along the own axes, `[N, 3]`, metres.
        sh_degree: highest band of spherical harmonics that will ever be used; higher ones are not allocated.
    """

    vertex_index: Tensor

    def __init__(self, means: Tensor, scales: Tensor, sh_degree: int) -> None:
        super().__init__()
        if not 0 <= sh_degree <= 3:
            raise ValueError(f"sh_degree is {sh_degree}; 0 to 3 are supported")
        n, bands = len(means), (sh_degree + 1) ** 2
        quats = torch.zeros(n, 4).to(means)
        quats[:, 0] = 1.0
        logit = math.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY))
        self.means = nn.Parameter(means.detach().clone())
        self.raw_quats = nn.Parameter(quats)
        self.log_scales = nn.Parameter(scales.detach().clamp(MIN_SCALE, MAX_SCALE).log())
        self.opacity_logits = nn.Parameter(means.new_full((n,), logit))
        self.sh0 = nn.Parameter(means.new_zeros(n, 1, 3))  # grey
        self.sh_rest = nn.Parameter(means.new_zeros(n, bands - 1, 3))
        self.register_buffer("vertex_index", torch.zeros(n, dtype=torch.int64, device=means.device))
        self.revision = 0
        """Counts replacements of rows or of their body vertices: what was derived from them is stale then."""

    @classmethod
    def on_body(
        cls,
        body: Body,
        sh_degree: int,
        least: int = 0,
        thickness: float = 0.0,
        heights: NDArray[np.float64] | None = None,
    ) -> Gaussians:
        """Returns one Gaussian on each vertex of the mean-shape body in the Da pose, grey and faint.

        Its size is that of `starting_sizes`.

        Args:
            body: whose surface.
            sh_degree: highest band of spherical harmonics that will ever be used.
            least: where a body has fewer vertices, the middles of its largest faces are taken as well, until there
                are so many or all faces are.
            thickness: standard deviation along the body's normal, metres; 0: Gaussians are round, as in 3DGS.
            heights: how far along the normal they are put off each vertex, `[V]`, metres; None: nowhere.
        """
        vertices = body.da_vertices()
        means = torch.cat([vertices, _middles_of_largest(vertices, body.faces, least - len(vertices))])
        sizes = starting_sizes(means)
        gaussians = cls(means, sizes[:, None].expand(-1, 3), sh_degree)
        index = nearest(means, vertices).indices[:, 0]
        gaussians.set_vertex_index(index)
        if thickness or heights is not None:
            found = vertex_normals(vertices.double().cpu().numpy(), body.faces.cpu().numpy())
            normals = torch.from_numpy(found).to(means)[index]
            if thickness:
                gaussians._flatten(normals, thickness)
            if heights is not None:
                gaussians.means.data += torch.from_numpy(heights).to(means)[index, None] * normals
        return gaussians

    @torch.no_grad()
    def _flatten(self, normals: Tensor, thickness: float) -> None:
        """Turns the third axes to the `normals [N, 3]` and makes the Gaussians at most `thickness` thick along them."""
        self.log_scales[:, 2].clamp_(max=math.log(max(thickness, MIN_SCALE)))
        self.raw_quats.copy_(z_axis_to(normals))

    @property
    def num_gaussians(self) -> int:
        """Gaussians at present."""
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Highest band of spherical harmonics that is allocated."""
        return math.isqrt(self.sh_rest.shape[1] + 1) - 1

    @property
    def scales(self) -> Tensor:
        """Standard deviations, `[N, 3]`, metres, within their bounds."""
        return self.log_scales.clamp(math.log(MIN_SCALE), math.log(MAX_SCALE)).exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities, `[N]`, between 6e-6 and 1 - 6e-6."""
        return self.opacity_logits.clamp(-MAX_LOGIT, MAX_LOGIT).sigmoid()

    def tensors(self) -> tuple[Tensor, ...]:
        """Returns what `of` takes: the parameters, in the order of `PARAMETERS`, and the vertices that they follow."""
        return (*(getattr(self, name) for name in PARAMETERS), self.vertex_index)

    @classmethod
    def of(cls, tensors: Sequence[Tensor]) -> Gaussians:
        """Returns Gaussians that are views of `tensors`, with their gradients: for functions of tensors alone."""
        gaussians = cls.__new__(cls)
        nn.Module.__init__(gaussians)
        gaussians.revision = 0
        for name, tensor in zip((*PARAMETERS, "vertex_index"), tensors, strict=True):
            object.__setattr__(gaussians, name, tensor)
        return gaussians

    def roots(self) -> Tensor:
        """Returns a root R S of each covariance: rotation times scales, `[N, 3, 3]`, metres."""
        return quaternion_to_matrix(self.raw_quats) * self.scales.unsqueeze(-2)

    def sh(self, degree: int) -> Tensor:
        """Returns the coefficients up to `degree`, `[N, (degree + 1)^2, 3]`."""
        count = (degree + 1) ** 2 - 1
        return torch.cat([self.sh0, self.sh_rest[:, :count]], dim=1) if count else self.sh0

    @torch.no_grad()
    def allocate_bands(self, sh_degree: int) -> None:
        """Makes room for bands up to `sh_degree`, new ones zero; before an optimiser is made."""
        missing = (sh_degree + 1) ** 2 - 1 - self.sh_rest.shape[1]
        if missing > 0:
            rest = self.sh_rest
            self.sh_rest = nn.Parameter(torch.cat([rest, rest.new_zeros(len(rest), missing, 3)], dim=1))

    def parameter_groups(self, rates: Mapping[str, float]) -> list[dict[str, Any]]:
        """Returns named parameter groups for Adam.

        Args:
            rates: learning rates by the names of `GROUPS`; others are ignored.
        """
        return [
            {"name": name, "params": [getattr(self, attribute)], "lr": rates[name]}
            for name, attribute in GROUPS.items()
            if name != "sh_rest" or self.sh_degree > 0
        ]

    def set_vertex_index(self, index: Tensor) -> None:
        """Names the body vertex whose skinning and blend shapes each Gaussian follows, `[N]`."""
        self.vertex_index = index.to(device=self.means.device, dtype=torch.int64)
        self.revision += 1

    def replace(self, rows: dict[str, Tensor], vertex_index: Tensor) -> None:
        """Puts other Gaussians in place of the present ones; `editing.write` sees to the optimiser."""
        for name in PARAMETERS:
            setattr(self, name, nn.Parameter(rows[name].detach().contiguous()))
        self.set_vertex_index(vertex_index)

    @torch.no_grad()
    def constrain(self) -> None:
        """Brings parameters that left their bounds back, so that their gradient is never cut off for good."""
        self.log_scales.clamp_(math.log(MIN_SCALE), math.log(WIDEST))
        self.opacity_logits.clamp_(-MAX_LOGIT, MAX_LOGIT)
        norms = self.raw_quats.norm(dim=-1, keepdim=True)
        least, most = norms.aminmax() if len(norms) else (norms.new_tensor(1.0),) * 2
        if not (least >= _NORM_RANGE[0] and most <= _NORM_RANGE[1]):
            is_off = (norms < _NORM_RANGE[0]) | (norms > _NORM_RANGE[1])
            self.raw_quats.copy_(torch.where(is_off, normalize_quaternion(self.raw_quats), self.raw_quats))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Makes room for the number of Gaussians that the state has, then loads as usual."""
        for name in (*PARAMETERS, "vertex_index"):
            have, given = getattr(self, name), state_dict.get(prefix + name)
            if given is not None and given.shape[1:] == have.shape[1:] and len(given) != len(have):
                # the Parameter object stays, so an optimiser made before goes on holding it
                have.data = have.new_empty(given.shape)
                have.grad = None
        super()._load_from_state_dict(state_dict, prefix, *args)
        self.revision += 1


def starting_sizes(points: Tensor) -> Tensor:
    """Returns standard deviations of Gaussians that begin at points, `[N]`, metres: as far as these are apart.

    The root of the mean squared distance to the three nearest others, as in 3DGS, within the bounds of scales.

    Args:
        points: `[N, 3]`, metres.
    """
    distances = nearest_others(points, min(INITIAL_NEIGHBOURS, len(points) - 1)).distances
    return distances.square().mean(dim=1).sqrt().clamp(MIN_SCALE, MAX_SCALE)


def _middles_of_largest(vertices: Tensor, faces: Tensor, count: int) -> Tensor:
    """Returns the middles of so many faces, the largest, in the order of the faces, `[count or fewer, 3]`."""
    if count <= 0:
        return vertices.new_zeros(0, 3)
    corners = vertices[faces]
    sides = corners[:, 1:] - corners[:, :1]
    areas = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=1)
    largest = areas.topk(min(count, len(areas))).indices.sort().values
    return corners[largest].mean(dim=1)


def means_rate(step: int, initial: float = 1.6e-4, final: float = 1.6e-6) -> float:
    """Returns the learning rate of the means at a step: log-linear over `MEANS_HORIZON` steps.

    Args:
        step: steps taken so far.
        initial: rate at step 0, learning rate of Adam.
        final: rate at `MEANS_HORIZON` and after.
    """
    if initial == 0 or final == 0:
        return 0.0 if initial == 0 else initial * max(0.0, 1 - step / MEANS_HORIZON)
    share = min(max(step / MEANS_HORIZON, 0.0), 1.0)
    return math.exp((1 - share) * math.log(initial) + share * math.log(final))
