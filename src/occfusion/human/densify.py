"""When and where Gaussians are added, joined and removed: 3DGS's rules with GauHuman's KL gates; ours for how."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from occfusion.errors import ConfigError
from occfusion.fields import check_fields, setting
from occfusion.geometry.neighbours import nearest, nearest_others
from occfusion.human import editing
from occfusion.human.avatar import Avatar
from occfusion.human.editing import Population
from occfusion.types import Camera


@dataclass(frozen=True)
class Densification:
    """Thresholds and schedule.

    Gradients have the units of 3DGS: the picture is 2 wide and 2 high, so the gradient per pixel is multiplied by half
    the width and half the height; the loss is a mean over pixels with weight 1.
    """

    after_step: int = setting(400, "nothing happens up to and including this step of the stage", 0)
    every: int = setting(200, "steps between two rounds", 1)
    before_step: int = setting(2201, "nothing happens from this step on", 0)
    gradient: float = setting(
        2e-4,
        "mean length of the gradient of the loss with respect to a centre in the picture, which is 2 wide and 2 high, "
        "above which a Gaussian is worked on",
        0,
    )
    dense: float = setting(
        0.01,
        "standard deviation in metres up to which a Gaussian is small: small ones are cloned or merged, others are "
        "split (GauHuman: 1 % of an extent of 1)",
        0,
    )
    kl_apart: float = setting(
        0.4, "a Gaussian is cloned or split only if its KL divergence to its nearest neighbour is above", 0
    )
    kl_alike: float = setting(
        0.1, "a small one is merged with its nearest neighbour if the divergence is below", 0
    )
    opacity: float = setting(0.005, "Gaussians fainter than this are removed", 0)
    from_body: float = setting(
        0.05, "Gaussians farther than this from the canonical body are removed, metres", 0
    )
    divide: bool = setting(
        False,
        "a Gaussian that is worked on is replaced by two that together look like it; false: cloned or split at drawn "
        "places, as in GauHuman, which changes the picture and sharpens it",
    )
    narrower: float = setting(
        1.0,
        "by how much the two of a divided Gaussian are narrower across its longest axis; above 1: sharper",
        1,
    )
    max_gaussians: int = setting(
        60_000, "no round makes more than this; those with the largest gradients come first", 0
    )
    min_gaussians: int = setting(100, "a round that would leave fewer removes none", 0)

    def __post_init__(self) -> None:
        check_fields(self, "densification")

    def rounds(self, steps: int) -> list[int]:
        """Returns after which of a stage's finished steps a round belongs; the stage has `steps`."""
        due = range(0, min(self.before_step, steps), self.every)
        return [step for step in due if step > self.after_step]


@dataclass(frozen=True)
class Round:
    """What one round did.

    Attributes:
        cloned: small Gaussians that became two.
        split: large ones that did.
        merged: pairs replaced by one.
        pruned: Gaussians removed.
        held_back: Gaussians that `max_gaussians` kept from being cloned or split.
        prune_refused: removing would have left fewer than `min_gaussians`, so none was removed.
        total: Gaussians afterwards.
    """

    cloned: int
    split: int
    merged: int
    pruned: int
    held_back: int
    prune_refused: bool
    total: int


class Densifier(nn.Module):
    """Collects screen-space gradients and edits the avatar when it is time.

    Its running sums are buffers, so that they are part of a checkpoint.

    Args:
        settings: thresholds and schedule.
        loss_scale: overall scale of the loss; gradients are divided by it, since the threshold was tuned for
            a loss of weight 1.
    """

    gradient_sum: Tensor
    count: Tensor

    def __init__(self, settings: Densification | None = None, loss_scale: float = 1.0) -> None:
        super().__init__()
        if not loss_scale > 0:
            raise ConfigError(f"densification: loss_scale is {loss_scale}; it must be above 0")
        self.settings = settings or Densification()
        self.loss_scale = loss_scale
        self.register_buffer("gradient_sum", torch.zeros(0))
        self.register_buffer("count", torch.zeros(0))

    @torch.no_grad()
    def observe(self, gradient: Tensor, radii: Tensor, camera: Camera) -> None:
        """Adds one picture's gradients to the running sums; Gaussians that were not drawn are left out.

        Args:
            gradient: gradient of the loss with respect to the centres in pixels, `[N, 2]`.
            radii: extents in the picture, `[N, 2]`; 0 where a Gaussian was culled.
            camera: whose picture it was.
        """
        if len(self.count) != len(gradient):
            self._restart(gradient)
        half_width, half_height = (0.5 * side / self.loss_scale for side in (camera.width, camera.height))
        # column by column: reductions over two numbers take three times as long
        is_drawn = (radii[:, 0] > 0) & (radii[:, 1] > 0)
        length = torch.hypot(gradient[:, 0] * half_width, gradient[:, 1] * half_height)
        self.gradient_sum += torch.where(is_drawn, length, 0.0)
        self.count += is_drawn

    def is_due(self, step: int) -> bool:
        """Returns whether a round belongs after `step` finished steps."""
        settings = self.settings
        return settings.after_step < step < settings.before_step and step % settings.every == 0

    @torch.no_grad()
    def step(
        self, step: int, avatar: Avatar, optimizer: torch.optim.Adam | None, *, seed: int = 0
    ) -> Round | None:
        """Does a round if one is due, on the avatar and the optimiser together; returns what it did.

        Clones, then splits, then merges, then prunes, as GauHuman does; the same seed and step give the same
        result.

        Args:
            step: finished steps.
            avatar: edited in place.
            optimizer: the Adam that holds its parameters.
            seed: of the draws of new centres.

        Returns:
            None if no round is due, or if nothing has been observed of the present Gaussians.
        """
        if not self.is_due(step) or len(self.count) != avatar.gaussians.num_gaussians:
            return None
        generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
        gradients = self.gradient_sum / self.count.clamp(min=1)
        population, done = self._edit(editing.read(avatar.gaussians, optimizer), gradients, generator)
        population, pruning = self._prune(population, avatar.da_vertices)
        vertex_index = nearest(population.values["means"], avatar.da_vertices).indices[:, 0]
        editing.write(population, avatar.gaussians, vertex_index, optimizer)
        avatar.forget_skinning()
        self._restart(population.values["means"])
        return Round(**done, **pruning, total=population.size)

    def _edit(
        self, population: Population, gradients: Tensor, generator: torch.Generator
    ) -> tuple[Population, dict[str, Any]]:
        """Clones and splits, or divides, and merges. New Gaussians have no gradient yet and wait a round."""
        settings = self.settings
        is_small = population.values["log_scales"].amax(dim=1).exp() <= settings.dense
        is_moving = gradients >= settings.gradient
        wanted = is_moving & (self._divergence(population)[0] > settings.kl_apart)
        chosen = self._limit(wanted, gradients, settings.max_gaussians - population.size)
        clones, splits = chosen & is_small, chosen & ~is_small
        counted = {"cloned": clones, "split": splits, "held_back": wanted & ~chosen}
        is_candidate = is_moving & is_small
        if settings.divide:
            population = editing.edit_divide(population, chosen, settings.narrower)
            is_candidate = is_candidate[~chosen]
        else:
            population = editing.edit_clone(population, clones, generator)
            is_candidate, splits = (_extend(flag, population.size) for flag in (is_candidate, splits))
            population = editing.edit_split(population, splits, generator)
            is_candidate = is_candidate[~splits]
        pairs = self._pairs(population, _extend(is_candidate, population.size))
        done = {key: int(flag.sum()) for key, flag in counted.items()}
        return editing.edit_merge(population, pairs), {**done, "merged": len(pairs)}

    def _divergence(self, population: Population) -> tuple[Tensor, Tensor]:
        """Returns each Gaussian's KL divergence to its nearest neighbour `[N]`, and that neighbour `[N]`."""
        own = torch.arange(population.size, device=population.values["means"].device)
        if population.size < 2:  # nobody near: apart from all, like none
            return torch.full_like(population.values["means"][:, 0], math.inf), own
        neighbour = nearest_others(population.values["means"]).indices[:, 0]
        return editing.kl_divergence(population.values, own, neighbour), neighbour

    def _limit(self, wanted: Tensor, gradients: Tensor, room: int) -> Tensor:
        """Returns `wanted`, cut down to the `room` largest gradients; each choice adds one Gaussian."""
        if int(wanted.sum()) <= room:
            return wanted
        order = torch.where(wanted, gradients, -1.0).argsort(descending=True, stable=True)
        chosen = torch.zeros_like(wanted)
        chosen[order[: max(room, 0)]] = True
        return chosen & wanted

    def _pairs(self, population: Population, is_candidate: Tensor) -> Tensor:
        """Returns the pairs to merge, `[P, 2]`, most alike first; no Gaussian is in two of them."""
        divergence, neighbour = self._divergence(population)
        alike = (is_candidate & (divergence < self.settings.kl_alike)).nonzero()[:, 0]
        alike = alike[divergence[alike].argsort(stable=True)]
        taken: set[int] = set()
        pairs: list[tuple[int, int]] = []
        for pair in zip(alike.tolist(), neighbour[alike].tolist(), strict=True):
            if taken.isdisjoint(pair):
                taken.update(pair)
                pairs.append(pair)
        return torch.tensor(pairs, dtype=torch.int64, device=neighbour.device).view(-1, 2)

    def _prune(self, population: Population, body: Tensor) -> tuple[Population, dict[str, Any]]:
        settings, values = self.settings, population.values
        is_far = nearest(values["means"], body).distances[:, 0] > settings.from_body
        keep = (values["opacity_logits"].sigmoid() >= settings.opacity) & ~is_far
        if int(keep.sum()) < min(settings.min_gaussians, population.size):
            return population, {"pruned": 0, "prune_refused": True}
        kept = editing.edit_keep(population, keep)
        return kept, {"pruned": population.size - kept.size, "prune_refused": False}

    def _restart(self, like: Tensor) -> None:
        self.gradient_sum = like.new_zeros(len(like))
        self.count = like.new_zeros(len(like))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        for name in ("gradient_sum", "count"):
            given = state_dict.get(prefix + name)
            if given is not None and given.dim() == 1:
                setattr(self, name, torch.zeros_like(given, device=getattr(self, name).device))
        super()._load_from_state_dict(state_dict, prefix, *args)


def _extend(flags: Tensor, size: int) -> Tensor:
    """Returns bool flags `[size]`: those given, then false."""
    return torch.cat([flags, flags.new_zeros(size - len(flags))])
