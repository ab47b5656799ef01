"""What the silhouette prior is shown of a person in a square crop: masks, body, and maps of the limbs."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from occfusion.observation.keypoints import LIMBS, NUM_KEYPOINTS

GROUPS = (
    ((1, 2), (1, 5), (1, 8), (1, 11)),  # trunk
    ((2, 3), (3, 4)),  # right arm
    ((5, 6), (6, 7)),  # left arm
    ((8, 9), (9, 10)),  # right leg
    ((11, 12), (12, 13)),  # left leg
    ((1, 0), (0, 14), (14, 16), (0, 15), (15, 17)),  # head
)
NUM_MAPS = len(GROUPS) + 1  # and one of all key points
WIDTH = 0.035
"""Standard deviation of a drawn limb, in crop widths."""

assert sorted(limb for group in GROUPS for limb in group) == sorted(LIMBS)


def limb_maps(points: Tensor, shown: Tensor, size: int) -> Tensor:
    """Returns a map of each group of limbs and one of the key points, `[B, 7, size, size]`, 0..1.

    A limb is drawn where both its ends are shown, with a soft edge, so that the maps have gradients and do not
    depend on the grid.

    Args:
        points: key points, `[B, 18, 2]`, in crop widths: 0..1 is the crop.
        shown: bool `[B, 18]`.
        size: pixels a side.
    """
    if points.shape[1:] != (NUM_KEYPOINTS, 2):
        raise ValueError(f"points must be [B, {NUM_KEYPOINTS}, 2]; got {list(points.shape)}")
    grid = (torch.arange(size, dtype=points.dtype, device=points.device) + 0.5) / size
    place = torch.stack(torch.meshgrid(grid, grid, indexing="xy"), dim=-1).reshape(1, 1, -1, 2)
    maps = []
    for group in GROUPS:
        first, second = ([limb[end] for limb in group] for end in (0, 1))
        drawn = _segments(place, points[:, first], points[:, second])
        drawn = drawn * (shown[:, first] & shown[:, second])[..., None]
        maps.append(drawn.amax(dim=1))
    dots = _segments(place, points, points) * shown[..., None]
    maps.append(dots.amax(dim=1))
    return torch.stack(maps, dim=1).reshape(len(points), NUM_MAPS, size, size)


def _segments(place: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Returns `exp(-d^2 / 2 w^2)` of the distance of each place to each segment, `[B, L, P]`."""
    along = (end - start)[:, :, None]
    length = along.square().sum(-1).clamp(min=1e-8)
    share = (((place - start[:, :, None]) * along).sum(-1) / length).clamp(0.0, 1.0)
    nearest = start[:, :, None] + share[..., None] * along
    return torch.exp(-0.5 * (place - nearest).square().sum(-1) / WIDTH**2)


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
