"""Batches for training and measuring the embedded inpainter: windows, colours and masks varied anew each time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.inpaint.corpus import Example, as_floats
from occfusion.inpaint.network import to_signal
from occfusion.inpaint.planes import ALPHA, COARSE, COMPLETE, GATHERED, OBSERVED, SEEN, SIZE, VISIBLE

WINDOW = 128
"""Pixels a side of the windows that are trained on: the network is convolutional."""
DROP_GATHERED, DROP_COMPLETE = 0.1, 0.1
MORE_HIDDEN = 0.3
PERMUTED, GAINS = 0.5, (0.55, 1.15)
HIDDEN_WEIGHT, SEEN_WEIGHT, REST_WEIGHT = 1.0, 0.2, 0.03
"""In the loss: of the hidden person, of the visible one, of the background."""

Planes = NDArray[np.float32]


@dataclass(frozen=True)
class Batch:
    """What the network is trained on.

    Attributes:
        clean: signals, `[B, 3, S, S]`.
        conditions: planes, `[B, 15, S, S]`.
        weight: of each pixel in the loss, `[B, 1, S, S]`.
    """

    clean: Tensor
    conditions: Tensor
    weight: Tensor

    def to(self, device: torch.device | str) -> Batch:
        """Returns the batch on `device`."""
        return Batch(self.clean.to(device), self.conditions.to(device), self.weight.to(device))


def make_batch(examples: Sequence[Example], rng: np.random.Generator) -> Batch:
    """Returns windows of examples, mirrored or not, in other colours, behind more occluders, parts untold.

    Args:
        examples: one for each window.
        rng: source of all choices.
    """
    return _stacked([_augmented(*as_floats(_window(example, rng)), rng) for example in examples])


def whole_batch(examples: Sequence[Example]) -> Batch:
    """Returns whole examples as they are."""
    return _stacked([as_floats(example) for example in examples])


def _stacked(rows: Sequence[tuple[Planes, Planes, Planes]]) -> Batch:
    planes, truth, mask = (torch.from_numpy(np.stack(part)) for part in zip(*rows, strict=True))
    return Batch(to_signal(truth, planes), planes, _weight(planes, mask))


def _weight(planes: Tensor, mask: Tensor) -> Tensor:
    person = torch.maximum(mask, planes[:, ALPHA]) > 0.1
    seen = planes[:, VISIBLE] > 0.5
    weight = torch.where(seen, SEEN_WEIGHT, torch.where(person, HIDDEN_WEIGHT, REST_WEIGHT))
    return weight[:, None]


def _window(example: Example, rng: np.random.Generator) -> Example:
    """Returns a window about a random pixel that is hidden."""
    hidden = (example.planes[VISIBLE] < 128) & ((example.mask > 127) | (example.planes[ALPHA] > 127))
    rows, columns = np.nonzero(hidden)
    if len(rows):
        k = int(rng.integers(len(rows)))
        middle = np.array([rows[k], columns[k]])
    else:
        middle = np.array([SIZE // 2, SIZE // 2])
    corner = middle + rng.integers(-WINDOW // 3, WINDOW // 3 + 1, 2) - WINDOW // 2
    y, x = (int(c) for c in np.clip(corner, 0, SIZE - WINDOW))
    cut = (..., slice(y, y + WINDOW), slice(x, x + WINDOW))
    return Example(example.planes[cut], example.truth[cut], example.mask[cut])


def _augmented(
    planes: Planes, truth: Planes, mask: Planes, rng: np.random.Generator
) -> tuple[Planes, Planes, Planes]:
    if rng.uniform() < 0.5:
        planes, truth, mask = (np.ascontiguousarray(a[..., ::-1]) for a in (planes, truth, mask))
    # a gain leaves blending over black as it is; a curve would not
    gains = rng.uniform(*GAINS) * rng.uniform(0.8, 1.25, 3)
    order = rng.permutation(3) if rng.uniform() < PERMUTED else np.arange(3)
    for part in (COARSE, GATHERED, OBSERVED):
        planes[part] = _coloured(planes[part], order, gains)
    truth = _coloured(truth, order, gains)
    if rng.uniform() < MORE_HIDDEN:
        y, x = rng.integers(0, WINDOW, 2)
        height, width = rng.integers(8, WINDOW // 2, 2)
        for plane in (*range(OBSERVED.start, OBSERVED.stop), VISIBLE):
            planes[plane, y : y + height, x : x + width] = 0.0
    if rng.uniform() < DROP_GATHERED:
        planes[GATHERED], planes[SEEN] = 0.0, 0.0
    if rng.uniform() < DROP_COMPLETE:
        planes[COMPLETE] = 0.0
    return planes, truth, mask


def _coloured(rgb: Planes, order: NDArray[np.int64], gains: NDArray[np.float64]) -> Planes:
    return np.clip(rgb[order] * gains[:, None, None], 0.0, 1.0).astype(np.float32)
