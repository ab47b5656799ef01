"""Adding, joining and removing Gaussians together with the optimiser's memory of them.

Every edit is a pure function from one `Population` to another. `read` takes a population out of a module and
its Adam, `write` puts one back. Rows that stay keep their moments. A row that is new starts with no momentum
but with the second moment of what it came from: with a zero there, Adam's bias correction being long over,
its first step would be three times the learning rate, whatever the gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from occfusion.geometry.rotation import matrix_to_quaternion, quaternion_to_matrix
from occfusion.human.gaussians import MAX_LOGIT, MAX_SCALE, MIN_SCALE, PARAMETERS, Gaussians

MOMENTS = ("exp_avg", "exp_avg_sq")
"""Adam's names of the running means of the gradient and of its square."""

SPLIT_COUNT = 2
SPLIT_SHRINKAGE = 0.8 * SPLIT_COUNT
"""3DGS: what a Gaussian is split into is smaller by this factor."""

DIVIDED_BY = 0.6
"""How far the two halves of a divided Gaussian lie from its centre, in its longest standard deviations."""


@dataclass(frozen=True)
class Population:
    """Gaussians with the optimiser's moments, one row each in every tensor.

    Attributes:
        values: the parameters by the names in `gaussians.PARAMETERS`.
        moments: by parameter, then by the names in `MOMENTS`; empty before the first step.
    """

    values: dict[str, Tensor]
    moments: dict[str, dict[str, Tensor]]

    @property
    def size(self) -> int:
        """Number of Gaussians."""
        return len(self.values["means"])


def edit_keep(population: Population, keep: Tensor) -> Population:
    """Returns the Gaussians where `keep [N]` (bool) is true, in their order."""
    return Population(
        {name: value[keep] for name, value in population.values.items()},
        {name: {k: v[keep] for k, v in kept.items()} for name, kept in population.moments.items()},
    )


def edit_clone(population: Population, chosen: Tensor, generator: torch.Generator) -> Population:
    """Returns the population with a copy of each Gaussian in `chosen [N]` (bool) appended.

    The copy's centre is drawn from the Gaussian itself, as in GauHuman; all else is equal.
    """
    values = {name: value[chosen] for name, value in population.values.items()}
    values["means"] = _draw(values, generator)
    return _append(population, values, _inherit(population, chosen.nonzero()[:, 0]))


def edit_split(population: Population, chosen: Tensor, generator: torch.Generator) -> Population:
    """Returns the population with each Gaussian in `chosen [N]` (bool) replaced by two smaller ones.

    Their centres are drawn from the Gaussian that they replace, their sizes are 1 / 1.6 of its size (3DGS).
    They stand at the end; the others keep their order.
    """
    rows = chosen.nonzero()[:, 0].repeat(SPLIT_COUNT)
    values = {name: value[rows] for name, value in population.values.items()}
    values["means"] = _draw(values, generator)
    shrunk = values["log_scales"].exp() / SPLIT_SHRINKAGE
    values["log_scales"] = shrunk.clamp(MIN_SCALE, MAX_SCALE).log()
    moments = _inherit(population, rows)
    return _append(edit_keep(population, ~chosen), values, moments)


def edit_divide(population: Population, chosen: Tensor, narrower: float = 1.0) -> Population:
    """Returns the population with each Gaussian in `chosen [N]` (bool) replaced by two that look like it.

    They lie on both sides of its centre on its longest axis and are shorter along that axis, so that both together
    have its mean and covariance. Their opacity makes them cover the area that it covered in a picture along that axis,
    where they overlap counted once. Colours and all else are its own: the picture stays nearly as it was, and what was
    trained is not lost. They stand at the end; the others keep their order.

    Args:
        population: all Gaussians.
        chosen: those to divide, bool `[N]`.
        narrower: by how much both are narrower across that axis. Above 1 they are sharper than the whole, and more
            opaque for it; where that would take more than opaque ones, they cover less than it did.
    """
    rows = chosen.nonzero()[:, 0]
    whole = {name: value[rows] for name, value in population.values.items()}
    scales = whole["log_scales"].exp()
    longest = scales.argmax(dim=1, keepdim=True)
    length = scales.gather(1, longest)
    axes = quaternion_to_matrix(whole["raw_quats"])
    along = axes.gather(2, longest[:, None].expand(-1, 3, 1)).squeeze(-1)
    shorter = math.sqrt(1.0 - DIVIDED_BY**2)
    shrunk = (scales / narrower).scatter(1, longest, length * shorter)
    whole["log_scales"] = shrunk.clamp(MIN_SCALE, MAX_SCALE).log()
    whole["opacity_logits"] = _halved(whole["opacity_logits"], shorter, narrower)
    both = {name: torch.cat([value, value]) for name, value in whole.items()}
    offset = DIVIDED_BY * length * along
    both["means"] += torch.cat([-offset, offset])
    return _append(edit_keep(population, ~chosen), both, _inherit(population, rows.repeat(2)))


def _halved(logits: Tensor, shorter: float, narrower: float) -> Tensor:
    """Returns the opacities, as logits, of two halves that cover what one Gaussian did.

    One of opacity o covers `o A`, two of opacity p and of the area `s A / w` each `s A (2 p - E p^2 / 2) / w`: the
    integral of the product of two Gaussians at a distance of 2 d is `E = exp(-(d / s)^2)` times that of the square of
    one.

    Args:
        logits: of the whole, `[N]`.
        shorter: s, with d^2 = 1 - s^2.
        narrower: w.
    """
    overlap = math.exp(1.0 - 1.0 / shorter**2)
    whole = logits.double().clamp(-MAX_LOGIT, MAX_LOGIT).sigmoid()
    under = 4.0 - 2.0 * overlap * whole * narrower / shorter
    half = ((2.0 - under.clamp(min=0.0).sqrt()) / overlap).clamp(max=1.0)
    return torch.logit(half).clamp(-MAX_LOGIT, MAX_LOGIT).to(logits)


def edit_merge(population: Population, pairs: Tensor) -> Population:
    """Returns the population with each pair of Gaussians replaced by one, appended at the end.

    The one has the mean and covariance of the pair taken as one distribution, weighted by opacity, the
    opacity `1 - (1 - a)(1 - b)` that both have where they overlap, and the weighted mean of the colours.
    (GauHuman takes plain means and 1 / 0.8 of the first one's size, which brightens and fattens what is
    merged.)

    Args:
        population: what to edit.
        pairs: rows, `[P, 2]`; no row in more than one pair.
    """
    if pairs.numel() == 0:
        return population
    old = population.values
    opacities = old["opacity_logits"].clamp(-MAX_LOGIT, MAX_LOGIT).sigmoid()[pairs]
    shares = opacities / opacities.sum(dim=1, keepdim=True)
    means = (shares[..., None] * old["means"][pairs]).sum(dim=1)
    quats, log_scales = _merged_shape(old, pairs, shares, means)
    transmitted = (1 - opacities).prod(dim=1)
    values = {
        "means": means,
        "raw_quats": quats,
        "log_scales": log_scales,
        "opacity_logits": (torch.log1p(-transmitted) - transmitted.log()).clamp(-MAX_LOGIT, MAX_LOGIT),
    }
    for name in ("sh0", "sh_rest"):
        values[name] = (shares[..., None, None] * old[name][pairs]).sum(dim=1)
    moments = {
        name: {"exp_avg": torch.zeros_like(values[name]), "exp_avg_sq": kept["exp_avg_sq"][pairs].mean(dim=1)}
        for name, kept in population.moments.items()
    }
    keep = torch.ones(population.size, dtype=torch.bool, device=pairs.device)
    keep[pairs.flatten()] = False
    return _append(edit_keep(population, keep), values, moments)


def kl_divergence(values: dict[str, Tensor], first: Tensor, second: Tensor) -> Tensor:
    """Returns KL(first || second) of Gaussian densities, `[P]`, for rows `first [P]` and `second [P]`.

    `1/2 (tr(S2^-1 S1) + d^t S2^-1 d - 3 + ln det S2 / det S1)`, computed from rotations and scales so that no
    matrix is inverted: in the axes of the second, lengths are divided by its scales.
    """
    rotations = quaternion_to_matrix(values["raw_quats"])
    log_scales = values["log_scales"]
    scales = log_scales.exp()
    # both the root of the first covariance and the distance, as the second one's own unit of length sees them
    to_second = rotations[second].transpose(1, 2) / scales[second].unsqueeze(-1)
    root = to_second @ (rotations[first] * scales[first].unsqueeze(-2))
    offset = to_second @ (values["means"][first] - values["means"][second]).unsqueeze(-1)
    log_ratio = 2 * (log_scales[second] - log_scales[first]).sum(dim=-1)
    return 0.5 * (root.square().sum(dim=(1, 2)) + offset.square().sum(dim=(1, 2)) - 3 + log_ratio)


def read(gaussians: Gaussians, optimizer: torch.optim.Adam | None) -> Population:
    """Returns the present Gaussians and their moments, detached."""
    values = {name: getattr(gaussians, name).detach() for name in PARAMETERS}
    moments = {}
    for name in PARAMETERS:
        state = {} if optimizer is None else optimizer.state.get(getattr(gaussians, name), {})
        if all(key in state for key in MOMENTS):
            moments[name] = {key: state[key].detach() for key in MOMENTS}
    return Population(values, moments)


def write(
    population: Population, gaussians: Gaussians, vertex_index: Tensor, optimizer: torch.optim.Adam | None
) -> None:
    """Puts a population into the module, and its moments into the optimiser, in place of what is there.

    Args:
        population: new Gaussians.
        gaussians: the module.
        vertex_index: nearest body vertex of each, `[N]`.
        optimizer: the Adam that holds the module's parameters, or None. Step counts are kept.
    """
    before = {name: getattr(gaussians, name) for name in PARAMETERS}
    gaussians.replace(population.values, vertex_index)
    if optimizer is None:
        return
    for name, old in before.items():
        _exchange(optimizer, old, getattr(gaussians, name), population.moments.get(name, {}))


def _exchange(
    optimizer: torch.optim.Adam, old: nn.Parameter, new: nn.Parameter, moments: dict[str, Tensor]
) -> None:
    for group in optimizer.param_groups:
        group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
    state: dict[str, Any] | None = optimizer.state.pop(old, None)
    if state is not None:
        optimizer.state[new] = {**state, **{key: value.contiguous() for key, value in moments.items()}}


def _draw(values: dict[str, Tensor], generator: torch.Generator) -> Tensor:
    """Returns a point drawn from each Gaussian, `[N, 3]`; the same on every device."""
    scales = values["log_scales"].exp()
    noise = torch.randn(scales.shape, generator=generator, dtype=torch.float64).to(scales)
    turned = quaternion_to_matrix(values["raw_quats"]) @ (scales * noise).unsqueeze(-1)
    return values["means"] + turned.squeeze(-1)


def _inherit(population: Population, rows: Tensor) -> dict[str, dict[str, Tensor]]:
    return {
        name: {"exp_avg": torch.zeros_like(kept["exp_avg"][rows]), "exp_avg_sq": kept["exp_avg_sq"][rows]}
        for name, kept in population.moments.items()
    }


def _append(
    population: Population, values: dict[str, Tensor], moments: dict[str, dict[str, Tensor]]
) -> Population:
    return Population(
        {name: torch.cat([value, values[name]]) for name, value in population.values.items()},
        {
            name: {key: torch.cat([value, moments[name][key]]) for key, value in kept.items()}
            for name, kept in population.moments.items()
        },
    )


def _merged_shape(
    old: dict[str, Tensor], pairs: Tensor, shares: Tensor, means: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns quaternions and log-scales of the pairs' joint covariances."""
    roots = quaternion_to_matrix(old["raw_quats"][pairs]) * old["log_scales"][pairs].exp().unsqueeze(-2)
    apart = (old["means"][pairs] - means[:, None]).unsqueeze(-1)
    # in float64, or the smallest axis of a thin Gaussian would drown in the rounding of the largest
    roots, apart = roots.double(), apart.double()
    each = roots @ roots.transpose(-1, -2) + apart @ apart.transpose(-1, -2)
    variances, axes = torch.linalg.eigh((shares.double()[..., None, None] * each).sum(dim=1))
    # eigenvectors may form a left-handed frame; an axis of an ellipsoid has no sign
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    scales = variances.clamp(min=MIN_SCALE**2, max=MAX_SCALE**2).sqrt()
    return matrix_to_quaternion(axes).to(means), scales.log().to(means)
