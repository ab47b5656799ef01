"""What the inpainter learns from: coarse avatars of training subjects, and batches of windows of them, varied anew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.human.avatar import Avatar
from occfusion.human.rendering import Renderer
from occfusion.inpaint.accumulation import Accumulated
from occfusion.inpaint.appearance_net import (
    ALPHA,
    COARSE,
    COMPLETE,
    DEPTH,
    GATHERED,
    OBSERVED,
    SEEN,
    SIZE,
    VISIBLE,
    take_picture,
    take_planes,
    to_signal,
)
from occfusion.inpaint.partial import KNOWN, SOLID, take_partial
from occfusion.observation.frames import ObservedFrame
from occfusion.prior_training.task import Batch
from occfusion.types import Frame


@dataclass(frozen=True)
class Example:
    """A partly hidden person, coarse avatar and truth, in the crop.

    Attributes:
        planes: of `PLANES`, uint8 `[15, S, S]`; depth is moved by one before it is scaled.
        truth: the person over black, uint8 `[3, S, S]`.
        mask: share of each pixel that the person covers, uint8 `[S, S]`.
    """

    planes: NDArray[np.uint8]
    truth: NDArray[np.uint8]
    mask: NDArray[np.uint8]


def make_examples(
    avatar: Avatar,
    frames: Sequence[Frame],
    observed_frames: Sequence[ObservedFrame],
    renderer: Renderer,
    accumulated: Accumulated,
) -> Iterator[Example]:
    """Yields an example for each occluded frame, whose truth must be known.

    Args:
        avatar: of the end of the optimisation stage, what no frame shows of it painted as the refinement does before it
            asks for references.
        frames: all training frames, with the complete masks that the avatar was trained with.
        observed_frames: of the same frames.
        renderer: draws the avatar.
        accumulated: what the frames show of it.
    """
    for frame, observed_frame in zip(frames, observed_frames, strict=True):
        if not observed_frame.evidence.occluded:
            continue
        assert frame.truth is not None
        observation = observed_frame.observation(frame, avatar.body)
        square, planes = take_planes(take_partial(avatar, accumulated, frame, observation, renderer))
        planes[DEPTH] = 0.5 * (planes[DEPTH] + 1.0)
        mask = frame.truth.mask.numpy().astype(np.float32)[..., None]
        truth = take_picture(square, np.concatenate([frame.truth.rgb.numpy(), mask], axis=-1))
        yield Example(_bytes(planes), _bytes(truth[:3]), _bytes(truth[3]))


def _bytes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.round(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8)


def as_floats(example: Example) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Returns planes, truth and mask of an example, or of windows of one, as they were."""
    planes = example.planes.astype(np.float32) / 255.0
    planes[DEPTH] = 2.0 * planes[DEPTH] - 1.0
    return planes, example.truth.astype(np.float32) / 255.0, example.mask.astype(np.float32) / 255.0


WINDOW = 128
"""Pixels a side of the windows that are trained on: the network is convolutional."""
DROP_GATHERED, DROP_COMPLETE = 0.1, 0.1
MORE_HIDDEN = 0.3
PERMUTED, GAINS = 0.5, (0.55, 1.15)
ABOUT_UNSEEN = 0.5
"""Share of the windows that lie about a pixel that no frame shows, where there is one."""
UNSEEN_WEIGHT, REGION_WEIGHT, EDGE_WEIGHT, SEEN_WEIGHT, REST_WEIGHT = 1.0, 0.25, 0.05, 0.025, 0.01
"""In the loss: of what no frame shows, of the rest of the paper's R, of the hidden person outside of it, of what is
seen, of the background."""

Planes = NDArray[np.float32]


def make_batch(examples: Sequence[Example], rng: np.random.Generator) -> Batch:
    """Returns windows of examples, mirrored or not, in other colours, behind more occluders, parts left out.

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


def region_of(planes: Tensor) -> Tensor:
    """Returns the paper's R in the crop, bool `[B, S, S]`; see `Partial.region`."""
    return (planes[:, VISIBLE] <= 0.5) & (planes[:, ALPHA] > SOLID)


def unseen_of(planes: Tensor) -> Tensor:
    """Returns where R shows what no frame of the video does, bool `[B, S, S]`; see `Partial.unseen`."""
    return region_of(planes) & (planes[:, SEEN] < KNOWN * planes[:, ALPHA])


def _weight(planes: Tensor, mask: Tensor) -> Tensor:
    edge = (planes[:, VISIBLE] <= 0.5) & (torch.maximum(mask, planes[:, ALPHA]) > 0.1)
    weight = torch.where(planes[:, VISIBLE] > 0.5, SEEN_WEIGHT, REST_WEIGHT)
    for pixels, value in (
        (edge, EDGE_WEIGHT), (region_of(planes), REGION_WEIGHT), (unseen_of(planes), UNSEEN_WEIGHT)
    ):  # fmt: skip
        weight = torch.where(pixels, value, weight)
    return weight[:, None]


def _window(example: Example, rng: np.random.Generator) -> Example:
    """Returns a window about a random pixel of R, often one that no frame shows."""
    shown = torch.from_numpy(example.planes[None].astype(np.float32) / 255.0)
    region, unseen = region_of(shown)[0].numpy(), unseen_of(shown)[0].numpy()
    chosen = unseen if rng.uniform() < ABOUT_UNSEEN and unseen.any() else region
    places = np.argwhere(chosen)
    middle = places[rng.integers(len(places))] if len(places) else np.array([SIZE // 2, SIZE // 2])
    corner = middle + rng.integers(-WINDOW // 3, WINDOW // 3 + 1, 2) - WINDOW // 2
    y, x = np.clip(corner, 0, SIZE - WINDOW)
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
