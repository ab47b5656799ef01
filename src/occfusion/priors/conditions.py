"""What the embedded silhouette prior is told of a person in a square crop."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from occfusion.priors.limbs import limb_maps


@dataclass(frozen=True)
class Conditions:
    """What is known of a batch of crops; a condition that is not known is zero everywhere.

    Attributes:
        visible: pixels that show the person, `[B, 1, S, S]`, 0 or 1.
        background: pixels known to be background, `[B, 1, S, S]`, 0 or 1.
        body: coverage and relative depth of the body mesh, `[B, 2, S, S]`.
        limbs: the pose, `[B, 7, S / 4, S / 4]`.
    """

    visible: Tensor
    background: Tensor
    body: Tensor
    limbs: Tensor

    def without(self, *names: str) -> Conditions:
        """Returns the conditions with those of the given names unknown."""
        return replace(self, **{name: torch.zeros_like(getattr(self, name)) for name in names})

    def to(self, device: torch.device | str) -> Conditions:
        """Returns the conditions on `device`."""
        return Conditions(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def expand(self, count: int) -> Conditions:
        """Returns each crop of the batch `count` times, one after the other."""
        parts = {f.name: getattr(self, f.name).repeat_interleave(count, dim=0) for f in fields(self)}
        return Conditions(**parts)

    def __getitem__(self, key: slice) -> Conditions:
        """Returns a part of the batch."""
        return Conditions(**{f.name: getattr(self, f.name)[key] for f in fields(self)})

    def __len__(self) -> int:
        """Returns the number of crops."""
        return len(self.visible)


def make_conditions(
    visible: Tensor, background: Tensor, coverage: Tensor, depth: Tensor, keypoints: Tensor, shown: Tensor
) -> Conditions:
    """Returns the conditions of a batch of crops.

    Args:
        visible: `[B, S, S]`, 0 or 1.
        background: `[B, S, S]`, 0 or 1.
        coverage: of the body, `[B, S, S]`, 0..1.
        depth: relative depth of the body, `[B, S, S]`, -1..1.
        keypoints: `[B, 18, 2]`, crop widths.
        shown: bool `[B, 18]`.
    """
    limbs = limb_maps(keypoints, shown, visible.shape[-1] // 4)
    return Conditions(visible[:, None], background[:, None], torch.stack([coverage, depth], dim=1), limbs)
