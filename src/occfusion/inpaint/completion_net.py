"""The network that completes a body's colours: the two pictures that it sees, what it answers, and its weights."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from occfusion.human.unfolded import UnfoldedBody
from occfusion.priors.embedded.network_file import Card, load_net
from occfusion.priors.embedded.unet import BlockUNet

COMPLETION = "completion"
NETWORK_VERSION = 3
SIZE = 128
"""Pixels a side of the pictures of front and back: a centimetre and a half each, as far apart as a body's vertices."""
SIDES = 2
PLANES_A_SIDE = 13
"""Filled colour 3, seen colour 3, how well seen 1, these two of the mirrored place 4, body 1, depth 1."""
PLANES = SIDES * PLANES_A_SIDE + 2
"""Of both sides, and the grid."""
FILLED = [0, 1, 2, PLANES_A_SIDE, PLANES_A_SIDE + 1, PLANES_A_SIDE + 2]
SEEN = [6, PLANES_A_SIDE + 6]
BODY = [11, PLANES_A_SIDE + 11]
"""Where each stands in the planes: front, then back."""

LEVEL = 0.4
"""Root mean square of what is seen, 0..1, in the units of the network: it is told of every person as this bright."""
DARKEST = 1e-3
"""Level that is taken for a person who is all black."""

COPIES = 3
"""Colours that a pixel's may be a mixture of: its own filled one, that of the other side, the mirrored one."""
OWN_FIRST = 2.0
"""Logit of its own before anything is learned."""

SPREAD_WEIGHT = 0.01
"""Of the spread's term in the loss, where the colours' has 1."""
LEAST_SPREAD = 0.005
"""Standard deviation of a colour, 0..1, at least: about one grey level of 256."""


def brightness_gain(filled: Tensor, seen: Tensor) -> float:
    """Returns what colours are multiplied by for the network, which so answers in proportion to any brightness.

    Args:
        filled: colours of all vertices, `[V, 3]`, 0..1.
        seen: how well each vertex is known, `[V]`, 0..1.
    """
    level = ((seen[:, None] * filled.square()).sum() / (3.0 * seen.sum()).clamp(min=1e-6)).sqrt()
    return LEVEL / max(float(level), DARKEST)


def completion_planes(body: UnfoldedBody, filled: Tensor, seen: Tensor) -> Tensor:
    """Returns what the network is told, `[PLANES, S, S]`.

    Args:
        body: whose vertices the others belong to.
        filled: colours of all vertices, by what is seen nearby where they are not seen, `[V, 3]`, 0..1.
        seen: how well each vertex is known, `[V]`, 0..1.
    """
    drawn = body.unfold(torch.cat([filled, filled * seen[:, None], seen[:, None]], dim=1))
    own = torch.cat(
        [drawn, drawn[:, 3:].flip(-1), body.mask[:, None].to(drawn), body.depth[:, None].to(drawn)], dim=1
    )
    return torch.cat([own.flatten(0, 1), body.grid.to(drawn)])


class CompletionNet(nn.Module):
    """Tells the colours of the body's two sides, and how sure they are.

    Much of what is not seen is like what is: the back of a striped shirt is striped at the same heights, the left
    sleeve is like the right one. So the answer is a mixture, pixel by pixel, of the filled colour, of that behind or
    before it, and of that at the mirrored place, and something of its own.

    Args:
        widths: channels at each level.
        depth: residual blocks of the lower levels.
    """

    def __init__(self, widths: tuple[int, ...] = (32, 64, 96), depth: int = 2) -> None:
        super().__init__()
        self.net = BlockUNet((3 + COPIES + 1) * SIDES, PLANES, 0, tuple(widths), depth)

    def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
        """Returns colours `[B, SIDES, 3, S, S]` and logarithms of their standard deviations `[B, SIDES, S, S]`.

        Args:
            planes: `[B, PLANES, S, S]`, S a multiple of 16.
        """
        planes = planes.contiguous(memory_format=torch.channels_last)
        now = planes.new_ones(len(planes))  # there is no noise, and so no time of a diffusion
        out = self.net(planes, None, now).unflatten(1, (SIDES, -1))
        own, logits, spread = out.split([3, COPIES, 1], dim=2)
        filled = planes[:, FILLED].unflatten(1, (SIDES, 3))
        copies = torch.stack([filled, filled.flip(1), filled.flip(-1)], dim=2)  # [B, side, copy, 3, S, S]
        preferred = logits.new_tensor([OWN_FIRST, 0.0, 0.0])[:, None, None]
        shares = (logits + preferred).softmax(dim=2)
        return (shares[:, :, :, None] * copies).sum(dim=2) + own, spread[:, :, 0]


def completion_loss(net: CompletionNet, truth: Tensor, planes: Tensor, weight: Tensor) -> Tensor:
    """Returns the mean distance to true colours, and beside it how badly the spread tells that distance.

    A mean distance asks for the median of what may be true, where a mean square asks for the mean of it, which is
    a blur wherever it is not known how far down a shirt reaches. The spread is that of a density which falls off with
    the distance d of colours, `exp(-2 d / s) / s^3`; it does not move the colours.

    Args:
        net: the network.
        truth: colours of both sides, `[B, SIDES * 3, S, S]`.
        planes: what the network sees, `[B, PLANES, S, S]`.
        weight: of each side's pixels, `[B, SIDES, S, S]`.
    """
    colors, spread = net(planes)
    distance = ((colors - truth.unflatten(1, (SIDES, 3))).square().sum(dim=2) + 1e-6).sqrt()
    spread = spread.clamp(min=math.log(LEAST_SPREAD))
    surprise = 2.0 * distance.detach() * (-spread).exp() + 3.0 * spread
    return ((distance + SPREAD_WEIGHT * surprise) * weight).sum() / weight.sum()


@cache
def load_completion_net(path: str | Path | None = None) -> tuple[CompletionNet, Card]:
    """Returns the network, ready to evaluate, and its card; see `load_net`.

    Loaded once a process, and so without drawing random numbers: those of a run must not depend on the one before it.
    """
    with torch.random.fork_rng(devices=[]):
        return check_completion_net(path)


def check_completion_net(path: str | Path | None = None) -> tuple[CompletionNet, Card]:
    """Loads the network, each time anew, to see that it can be; draws the random numbers that making one takes."""
    return load_net(path, COMPLETION, SIZE, CompletionNet, "prior.completion.weights", NETWORK_VERSION)
