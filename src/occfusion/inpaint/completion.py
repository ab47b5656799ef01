"""Completion of colours: what no frame shows of a person, once, in canonical space.

What is asked is the body's surface, not a view of it: so all views agree with each other, and nothing is asked again
frame by frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from occfusion.fields import setting
from occfusion.files.atomic import write_bytes, write_png
from occfusion.geometry.neighbours import nearest
from occfusion.human.avatar import Avatar
from occfusion.human.body import Body
from occfusion.human.unfolded import UnfoldedBody
from occfusion.inpaint.accumulation import Accumulated
from occfusion.inpaint.completion_net import (
    FILLED,
    LEAST_SPREAD,
    SIDES,
    SIZE,
    brightness_gain,
    completion_planes,
    load_completion_net,
)

NEIGHBOURS = 4
"""Gaussians that speak for a vertex, and vertices that speak for a Gaussian."""
MOST_SPREAD = 0.5
"""Standard deviation of a colour, 0..1, at most, in the brightness that the network sees."""
CLOSE = 0.003
"""Metres added to distances, so that a Gaussian on a vertex does not count infinitely."""


@dataclass(frozen=True)
class CompletionSettings:
    """Settings of the completion of colours."""

    weights: str | None = setting(
        None, "a `.safetensors` file of `stage=prior prior_training=completion`; null: the package's"
    )


@dataclass(frozen=True)
class Completion:
    """Colours of the body's surface.

    Attributes:
        filled: by what is seen nearby, `[V, 3]`, 0..1.
        seen: how well each vertex is known, `[V]`, 0..1.
        colors: completed, `[V, 3]`, 0..1.
        spread: standard deviation of each channel that the network expects, `[V]`; 0 where it is seen.
    """

    filled: Tensor
    seen: Tensor
    colors: Tensor
    spread: Tensor


class ColorCompleter:
    """Our own model of the two sides of dressed people, weights in the package.

    Args:
        body: of the avatars; of any topology.
        settings: which weights.
        device: where the network runs.
    """

    def __init__(self, body: Body, settings: CompletionSettings, device: torch.device | str = "cpu") -> None:
        self.settings = settings
        self.device = torch.device(device)
        self.body = UnfoldedBody(body, SIZE)
        self.vertices = body.da_vertices().detach().cpu()
        self.net, self.card = load_completion_net(settings.weights)
        self.net.to(self.device)

    def describe(self) -> dict[str, Any]:
        """Returns the hash of the weights."""
        return {"completion": "embedded", "weights_sha256": self.card["sha256"]}

    @torch.no_grad()
    def complete(self, filled: Tensor, seen: Tensor) -> Completion:
        """Returns completed colours of the body's vertices.

        Args:
            filled: colours by what is seen nearby, `[V, 3]`, 0..1.
            seen: how well each vertex is known, `[V]`, 0..1.
        """
        gain = brightness_gain(filled, seen)
        planes = completion_planes(self.body, gain * filled, seen)[None].to(self.device)
        expected, spread = (part[0].cpu() for part in self.net(planes))
        unseen = 1.0 - seen
        lacking = self.body.fold(expected - planes[0, FILLED].cpu().unflatten(0, (SIDES, 3))) / gain
        colors = (filled + unseen[:, None] * lacking).clamp(0.0, 1.0)
        unsure = self.body.fold(spread.exp().clamp(LEAST_SPREAD, MOST_SPREAD)[:, None])[:, 0] / gain
        return Completion(filled, seen, colors, unseen * unsure)

    def of_avatar(self, avatar: Avatar, accumulated: Accumulated) -> tuple[Accumulated, Completion]:
        """Returns what a video shows of an avatar's Gaussians with the rest completed; and the body's surface.

        Args:
            avatar: on the same body.
            accumulated: of its Gaussians.
        """
        means = avatar.gaussians.means.detach().cpu()
        shares, chosen = _near(self.vertices, means)
        filled = (shares[..., None] * accumulated.colors.cpu()[chosen]).sum(dim=1)
        seen = (shares * accumulated.seen.cpu()[chosen]).sum(dim=1)
        found = self.complete(filled, seen)
        shares, chosen = _near(means, self.vertices)
        added = (shares[..., None] * (found.colors - found.filled)[chosen]).sum(dim=1).to(accumulated.colors)
        return replace(accumulated, colors=(accumulated.colors + added).clamp(0.0, 1.0)), found


def _near(points: Tensor, references: Tensor) -> tuple[Tensor, Tensor]:
    """Returns shares and indices of the references that speak for each point, `[N, k]` each."""
    found = nearest(points, references, min(NEIGHBOURS, len(references)))
    weights = (found.distances + CLOSE).pow(-2)
    return weights / weights.sum(dim=1, keepdim=True), found.indices


def write_completion(table: Path, picture: Path, completion: Completion, body: UnfoldedBody) -> None:
    """Writes completed colours by vertex, and a picture of them.

    Args:
        table: `.npz` with `colors`, `filled`, `seen` and `spread`, one row a vertex.
        picture: front and back: by what is seen nearby, completed, how well seen, and how unsure (white: 0.2).
        completion: what was found.
        body: whose vertices they are.
    """
    parts = {name: value.numpy() for name, value in vars(completion).items()}
    content = BytesIO()
    np.savez_compressed(content, **{name: value.astype(np.float16) for name, value in parts.items()})
    write_bytes(table, content.getvalue())
    grey = [each[:, None].expand(-1, 3) for each in (completion.seen, 5.0 * completion.spread)]
    rows = [completion.filled, completion.colors, *grey]
    drawn = torch.cat([torch.cat(list(body.unfold(row.float())), dim=2) for row in rows], dim=1)
    pixels = (drawn.permute(1, 2, 0).clamp(0.0, 1.0) * 255.0 + 0.5).byte().numpy()
    write_png(picture, pixels)
