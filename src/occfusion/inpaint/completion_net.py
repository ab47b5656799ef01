"""The network that completes a body's colours: the two pictures that it sees, what it predicts, and its weights."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from occfusion.human.unfolded import UnfoldedBody
from occfusion.priors.embedded.diffusion import alpha_sigma
from occfusion.priors.embedded.network_file import Card, load_net
from occfusion.priors.embedded.unet import BlockUNet

COMPLETION = "completion"
NETWORK_VERSION = 1
SIZE = 128
"""Pixels a side of the pictures of front and back: a centimetre and a half each, as far apart as a body's vertices."""
SIDES = 2
PLANES_A_SIDE = 13
"""Filled colour 3, observed colour 3, seen 1, the same of the mirrored place 4, body 1, depth 1."""
PLANES = SIDES * PLANES_A_SIDE + 2
"""Of both sides, and the grid."""
FILLED = [0, 1, 2, PLANES_A_SIDE, PLANES_A_SIDE + 1, PLANES_A_SIDE + 2]
SEEN = [6, PLANES_A_SIDE + 6]
BODY = [11, PLANES_A_SIDE + 11]
"""Where each stands in the planes: front, then back."""

COPIES = 3
"""Colours that a pixel's may be a mixture of: its own filled one, that of the other side, the mirrored one."""
OWN_FIRST = 2.0
"""Logit of its own before anything is learned."""

KNEE = 0.05
"""Difference of colours up to which the signal grows in proportion; beyond, with its logarithm."""
SPAN = math.asinh(1.0 / KNEE)


def completion_planes(body: UnfoldedBody, filled: Tensor, observed: Tensor, seen: Tensor) -> Tensor:
    """Returns what the network is told, `[PLANES, S, S]`.

    Args:
        body: whose vertices the others belong to.
        filled: colours of all vertices by what is seen nearby, `[V, 3]`, 0..1.
        observed: mean observed colours, `[V, 3]`; anything where nothing was observed.
        seen: how well each vertex is known, `[V]`, 0..1.
    """
    drawn = body.unfold(torch.cat([filled, observed * seen[:, None], seen[:, None]], dim=1))
    own = torch.cat(
        [drawn, drawn[:, 3:].flip(-1), body.mask[:, None].to(drawn), body.depth[:, None].to(drawn)], dim=1
    )
    return torch.cat([own.flatten(0, 1), body.grid.to(drawn)])


def to_signal(truth: Tensor, planes: Tensor) -> Tensor:
    """Returns the signal of true colours, -1..1, `[B, 6, S, S]` for both of `[B, ., S, S]`: what `filled` lacks."""
    return torch.asinh((truth - planes[:, FILLED]) / KNEE) / SPAN


def from_signal(signal: Tensor) -> Tensor:
    """Returns what is to be added to the filled colours."""
    return KNEE * torch.sinh(SPAN * signal)


class CompletionNet(nn.Module):
    """Predicts v of the difference between true colours of the body's two sides and the filled ones.

    Much of what is not seen is like what is: the back of a striped shirt is striped at the same heights, the left
    sleeve is like the right one. So v is that of a mixture, pixel by pixel, of the filled colour, of that behind or
    before it, and of that at the mirrored place (`- sigma` times its signal), and something of its own.

    Args:
        widths: channels at each level.
        depth: residual blocks of the lower levels.
    """

    def __init__(self, widths: tuple[int, ...] = (32, 64, 96), depth: int = 2) -> None:
        super().__init__()
        self.net = BlockUNet((3 + COPIES) * SIDES, 3 * SIDES + PLANES, 0, tuple(widths), depth)

    def forward(self, noisy: Tensor, t: Tensor, planes: Tensor) -> Tensor:
        """Returns v, `[B, 6, S, S]`, for `noisy [B, 6, S, S]`, `t [B]` and `planes [B, PLANES, S, S]`."""
        fine = torch.cat([noisy, planes], dim=1).contiguous(memory_format=torch.channels_last)
        own, logits = self.net(fine, None, t).split([3 * SIDES, COPIES * SIDES], dim=1)
        filled = planes[:, FILLED].unflatten(1, (SIDES, 3))
        copies = torch.stack([filled, filled.flip(1), filled.flip(-1)], dim=2)  # [B, side, copy, 3, S, S]
        preferred = logits.new_tensor([OWN_FIRST, 0.0, 0.0])[:, None, None]
        shares = (logits.unflatten(1, (SIDES, COPIES)) + preferred).softmax(dim=2)
        copied = to_signal((shares[:, :, :, None] * copies).sum(dim=2).flatten(1, 2), planes)
        return own - alpha_sigma(t)[1][:, None, None, None] * copied


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
