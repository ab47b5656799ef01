"""What a video shows of each Gaussian: its observed colours, accumulated in canonical space over all frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from occfusion.geometry.neighbours import nearest
from occfusion.human.avatar import Avatar
from occfusion.human.rendering import Renderer
from occfusion.splat.harmonics import SH_C0
from occfusion.types import Cloud, Frame

ENOUGH = 4.0
"""Pixels, summed over frames, from which on a Gaussian's own colour counts more than that of its neighbours.

Half of the Gaussians that are seen at all have enough: few pixels for many Gaussians leave no better ones to ask.
"""
SOME = 0.1
"""Pixels, summed over frames, from which on a Gaussian counts among those that are seen at all."""
NEIGHBOURS = 6
MIRROR_DISTANCE = 0.03
"""Metres that a neighbour on the other side of the body counts as farther away."""
BEHIND, BLUR = 0.03, 0.01
"""Metres behind what a pixel shows at which a Gaussian there counts half, and within which that changes: limbs are
thicker, and the layer that Gaussians of one side make is thinner."""

PASSES = 2
"""Times that pictures of accumulated colours are compared with the frames: more bring noise and little detail."""


@dataclass(frozen=True)
class Accumulated:
    """The colours of Gaussians as observed.

    Attributes:
        colors: mean observed colour, `[N, 3]`, 0..1, under even light; where little was seen, that of what was
            seen nearby or at the mirrored place of the body.
        weights: visible pixels that each Gaussian made up, summed over all frames, `[N]`.
    """

    colors: Tensor
    weights: Tensor

    @property
    def seen(self) -> Tensor:
        """How well each Gaussian is known, `[N]`, 0 never seen .. 1 seen in many pixels."""
        return known_share(self.weights)


def accumulate(
    avatar: Avatar,
    frames: Iterable[Frame],
    renderer: Renderer,
    opacity: float | None = None,
    *,
    through: bool = True,
) -> Accumulated:
    """Returns what the visible pixels of `frames` show of the avatar's Gaussians; arguments as those of `gather`."""
    colors, weights = gather(avatar, frames, renderer, opacity, through=through)
    return Accumulated(with_neighbours(colors, weights, avatar.gaussians.means.detach()), weights)


@torch.enable_grad()
def gather(
    avatar: Avatar,
    frames: Iterable[Frame],
    renderer: Renderer,
    opacity: float | None = None,
    *,
    through: bool = True,
) -> tuple[Tensor, Tensor]:
    """Returns mean colours of the avatar's Gaussians in the visible pixels of `frames`, and how many these are.

    A picture is linear in the colours of its Gaussians. The gradient of its sum over the visible pixels is
    therefore each Gaussian's blending weight there, and that of its product with the observation the weighted
    sum of what was observed. With the picture's mean depth in place of the observation it tells how far behind what
    its pixels show a Gaussian lies.

    Args:
        avatar: posed for each frame; not changed.
        frames: with their visible masks.
        renderer: draws the avatar.
        opacity: of all Gaussians, where the avatar has not learned its own yet; None: its own.
        through: whether what shines through what is in front counts as seen. It has the colours of that; where a
            person does not turn, no other frame says better.

    Returns:
        colours `[N, 3]`, 0..1, black where nothing is seen, and visible pixels that each Gaussian made up, `[N]`.
    """
    count = avatar.gaussians.num_gaussians
    means = avatar.gaussians.means.detach()
    weights, sums = means.new_zeros(count), means.new_zeros(count, 3)
    for frame in frames:
        with torch.no_grad():
            carried = avatar.deform(frame.pose.to(means.device))
            shade, opacities = avatar.brightness(carried), avatar.gaussians.opacities
            if opacity is not None:
                opacities = torch.full_like(opacities, opacity)
        depths = frame.camera.depths(carried.means)
        ones, zeros = torch.ones_like(depths), torch.zeros_like(depths)
        colors = torch.stack([depths, ones, zeros], dim=1).requires_grad_()
        cloud = Cloud(carried.means, carried.covariances, opacities, colors, avatar.dilation)
        rgb = renderer.draw(cloud, frame.camera).rgb
        visible = frame.visible_mask.to(rgb)
        depth = (rgb[..., 0] / rgb[..., 1].clamp(min=1e-6)).detach()
        asked = torch.stack([visible, visible * depth, torch.zeros_like(visible)], dim=-1)
        (seen,) = torch.autograd.grad(rgb, colors, asked, retain_graph=True)
        (observed,) = torch.autograd.grad(rgb, colors, visible[..., None] * frame.rgb.to(rgb))
        behind = depths - seen[:, 1] / seen[:, 0].clamp(min=1e-9)
        counts = torch.ones_like(behind) if through else torch.sigmoid((BEHIND - behind) / BLUR)
        weights += counts * seen[:, 0]
        sums += counts[:, None] * (observed if shade is None else observed / shade[:, None])
    return sums / weights.clamp(min=1e-6)[:, None], weights


def sharpened(
    avatar: Avatar, frames: Callable[[], Iterable[Frame]], renderer: Renderer, accumulated: Accumulated
) -> Accumulated:
    """Returns colours with the detail that means have lost: narrow stripes keep 53 to 62 % of their contrast there.

    A mean over the pixels that a Gaussian helps to make is a blurred picture. What pictures of these means lack is
    accumulated alike and added, `PASSES` times (simultaneous iterative reconstruction, Gilbert 1972). What is seen in
    fewer pixels than others gets less of it, and what is hardly seen keeps the colours of its neighbours.

    Args:
        avatar: posed for each frame; not changed.
        frames: gives some of those that were accumulated, at each call the same.
        renderer: draws the avatar.
        accumulated: of the avatar.
    """
    known = accumulated.weights > SOME
    if not bool(known.any()):
        return accumulated
    weights = accumulated.weights
    trusted = accumulated.seen * weights / (weights + weights[known].median())
    colors, counts = accumulated.colors, torch.zeros_like(weights)
    for number in range(PASSES):
        lacking = torch.zeros_like(colors)
        for frame in frames():
            with torch.no_grad():
                carried = avatar.deform(frame.pose.to(colors.device))
                shade = avatar.brightness(carried)
            shade = torch.ones_like(weights) if shade is None else shade
            drawn = (colors * shade[:, None]).requires_grad_()
            cloud = Cloud(
                carried.means,
                carried.covariances,
                avatar.gaussians.opacities.detach(),
                drawn,
                avatar.dilation,
            )
            rgb = renderer.draw(cloud, frame.camera).rgb
            visible = frame.visible_mask.to(rgb)[..., None].expand_as(rgb)
            asked = visible * (frame.rgb.to(rgb) - rgb.detach())
            if number == 0:
                (seen,) = torch.autograd.grad(rgb, drawn, visible, retain_graph=True)
                counts += seen[:, 0]
            lacking += torch.autograd.grad(rgb, drawn, asked)[0] / shade[:, None]
        step = trusted[:, None] * lacking / counts.clamp(min=SOME)[:, None]
        colors = (colors + step).clamp(0.0, 1.0)
    return replace(accumulated, colors=colors)


@torch.no_grad()
def paint_observed(avatar: Avatar, accumulated: Accumulated) -> None:
    """Gives all Gaussians their accumulated colours, the same from all sides; changes the avatar's in place."""
    gaussians = avatar.gaussians
    gaussians.sh0.copy_(_as_harmonics(accumulated.colors.to(gaussians.sh0)))
    gaussians.sh_rest.zero_()


@torch.no_grad()
def paint_unseen(avatar: Avatar, accumulated: Accumulated) -> None:
    """Gives what the video hardly shows the colour of what it shows nearby; changes the avatar's colours in place.

    A Gaussian that no frame shows keeps the grey that it began with, which an inpainter takes for a part of the
    person. What is well seen stays as it was learned; in between the two are mixed.
    """
    gaussians = avatar.gaussians
    seen = accumulated.seen.to(gaussians.sh0)[:, None, None]
    nearby = _as_harmonics(accumulated.colors.to(gaussians.sh0))
    gaussians.sh0.copy_(seen * gaussians.sh0 + (1.0 - seen) * nearby)
    gaussians.sh_rest.mul_(seen)


def learning_shares(avatar: Avatar, accumulated: Accumulated) -> Tensor:
    """Returns what share of the learning rate the colours at each vertex get, `[V]`, 0..1.

    As large as the share of what frames show there. What only shines through has gradients of next to nothing, but
    Adam takes full steps by them: over a training they would carry such colours anywhere.
    """
    total = accumulated.weights.new_zeros(len(avatar.da_vertices))
    return known_share(total.index_add(0, avatar.gaussians.vertex_index, accumulated.weights))


def known_share(weights: Tensor) -> Tensor:
    """Returns how well Gaussians are known that made up so many visible pixels, `[N]`, 0..1."""
    return weights / (weights + _enough(weights))


def _enough(weights: Tensor) -> float:
    some = weights[weights > SOME]
    return min(ENOUGH, float(some.median())) if len(some) else ENOUGH


def _as_harmonics(colors: Tensor) -> Tensor:
    return ((colors - 0.5) / SH_C0)[:, None]


def with_neighbours(colors: Tensor, weights: Tensor, means: Tensor) -> Tensor:
    """Returns `colors` mixed with those of well-seen neighbours, the more so the less a place was seen itself.

    Args:
        colors: as observed, `[N, 3]`.
        weights: visible pixels that show each place, `[N]`.
        means: places, `[N, 3]`, metres, in the canonical pose.
    """
    enough = _enough(weights)
    known = weights >= enough
    if not bool(known.any()):
        return torch.full_like(colors, 0.5)
    mirrored = means[known] * means.new_tensor([-1.0, 1.0, 1.0])
    count = min(NEIGHBOURS, int(known.sum()))
    same, other = nearest(means, means[known], count), nearest(means, mirrored, count)
    indices = torch.cat([same.indices, other.indices], dim=1)
    distances = torch.cat([same.distances, other.distances + MIRROR_DISTANCE], dim=1)
    # the scale is that of the nearest: far from all that was seen, the nearest still count most
    near = (-distances / (distances.amin(dim=1, keepdim=True) + 0.005)).exp() * weights[known][indices].sqrt()
    filled = (near[..., None] * colors[known][indices]).sum(dim=1) / near.sum(dim=1, keepdim=True)
    share = known_share(weights)[:, None]
    return share * colors + (1.0 - share) * filled
