"""The network on the part of mostly black pictures that is not black; what is left out is known beforehand.

Far from any lit pixel the activations are those of an entirely black picture. They depend on the distance to the
picture's borders alone, so they are computed once on a small black picture, and each layer is evaluated only where
a lit pixel can be felt: the region grows by one position with each convolution and halves with each pooling.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from occfusion.perceptual.network import BLOCKS, VggFeatures
from occfusion.types import Box

SMALL = 320
"""Least side in pixels of the small black picture. The borders are felt 8 positions deep in the last block, that is
128 px, so that more than 32 px in the middle feel none of them."""
PHASE = 16
"""Four poolings: sides that differ by a multiple of 16 px end alike."""
Span = tuple[int, int]


@dataclass(frozen=True)
class Part:
    """One block's activations where they can differ from those of a black picture.

    Attributes:
        values: `[B, C, h, w]`.
        positions: how many positions the block has in the whole picture.
    """

    values: Tensor
    positions: int


class BlackSurround:
    """Evaluates a network on boxes of pictures that are black outside; keeps what it knows of black pictures.

    Args:
        network: the trunk; frozen.
    """

    def __init__(self, network: VggFeatures) -> None:
        self._network = network
        self._black: dict[tuple[object, ...], list[Tensor]] = {}

    @torch.no_grad()
    def parts(self, pictures: Tensor, box: Box, black: float) -> list[Part]:
        """Returns the five blocks' activations of pictures `[B, 3, H, W]`, where the box can be felt.

        Args:
            pictures: as the network takes them.
            box: outside it all pictures are black.
            black: the value of black.
        """
        height, width = pictures.shape[2:]
        inputs = self._inputs_of_black(height, width, black)
        x, y, w, h = box
        rows, columns, size = (y, y + h), (x, x + w), (height, width)
        patch = self._network.whiten(pictures[:, :, y : y + h, x : x + w])
        parts = []
        for number, step in enumerate(steps()):
            patch, rows, columns, size = self._step(step, patch, rows, columns, size, inputs[number])
            if step in LAST:
                parts.append(Part(patch, size[0] * size[1]))
        return parts

    def _inputs_of_black(self, height: int, width: int, black: float) -> list[Tensor]:
        """Returns the input of every step for a small black picture whose borders are like a large one's."""
        size = small(height), small(width)
        dtype, device = self._network.dtype, self._network.mean.device
        key = (*size, black, dtype, device)
        if key not in self._black:
            x = torch.full((1, 3, *size), black, dtype=dtype, device=device)
            x, inputs = self._network.whiten(x), []
            for step in steps():
                inputs.append(x)
                x = self._network.pool(x) if step == POOL else self._network.convolve(x, step)
            self._black = {key: inputs}  # pictures of one evaluation are of one size
        return self._black[key]

    def _step(
        self, step: str, patch: Tensor, rows: Span, columns: Span, size: Span, black: Tensor
    ) -> tuple[Tensor, Span, Span, Span]:
        """Applies one step to what fills `rows` and `columns` of a map of `size`; returns the same of its output."""
        pools, antialiased = step == POOL, self._network.antialiased
        axes = [_plan(span, n, pools, antialiased) for span, n in ((rows, size[0]), (columns, size[1]))]
        canvas = black
        for axis, (plan, length) in enumerate(zip(axes, size, strict=True), 2):
            needed = torch.arange(plan.first, plan.stop, device=black.device)
            canvas = canvas.index_select(axis, _in_small(needed, length, black.shape[axis]))
        canvas = canvas.expand(len(patch), -1, -1, -1).contiguous(memory_format=torch.channels_last)
        top, left = rows[0] - axes[0].first, columns[0] - axes[1].first
        inside = canvas[
            :, :, max(top, 0) : rows[1] - axes[0].first, max(left, 0) : columns[1] - axes[1].first
        ]
        inside.copy_(patch[:, :, max(-top, 0) :, max(-left, 0) :][:, :, : inside.shape[2], : inside.shape[3]])
        if not pools:
            beyond = (axes[1].before, axes[1].after, axes[0].before, axes[0].after)
            out = self._network.convolve(F.pad(canvas, beyond), step, padding=0)
        elif antialiased:
            canvas = F.max_pool2d(canvas, 2, stride=1)
            for axis, plan in enumerate(axes, 2):
                wanted = torch.tensor(plan.order, device=canvas.device)
                canvas = canvas.index_select(axis, wanted)
            out = self._network.blur(canvas)
        else:
            out = F.max_pool2d(canvas, 2)
        spans = [plan.output for plan in axes]
        return out, spans[0], spans[1], (axes[0].length, axes[1].length)


POOL = "pool"
LAST = {f"conv{number}_{len(block)}" for number, block in enumerate(BLOCKS, 1)}


def steps() -> list[str]:
    """Returns the network's steps in order: names of convolutions, and `pool`."""
    names: list[str] = []
    for number, block in enumerate(BLOCKS, 1):
        names += [POOL] * (number > 1) + [f"conv{number}_{part}" for part, _ in enumerate(block, 1)]
    return names


def small(length: int) -> int:
    """Returns the side of the small black picture that stands for one of `length` px."""
    return length if length < SMALL + PHASE else SMALL + (length - SMALL) % PHASE


@dataclass(frozen=True)
class _Axis:
    """What a step reads and writes along one axis.

    Attributes:
        output: the positions of the output that are computed.
        length: the whole output's length.
        first: first position of the input that is read.
        stop: behind the last one.
        before: zeros before them.
        after: zeros behind them.
        order: for the anti-aliased pooling, which of the maxima are blurred, mirrored at the picture's borders.
    """

    output: Span
    length: int
    first: int
    stop: int
    before: int = 0
    after: int = 0
    order: tuple[int, ...] = ()


def _plan(span: Span, length: int, pools: bool, antialiased: bool) -> _Axis:
    start, stop = span
    if not pools:
        out = max(start - 1, 0), min(stop + 1, length)
        first, last = out[0] - 1, out[1] + 1
        return _Axis(out, length, max(first, 0), min(last, length), max(-first, 0), max(last - length, 0))
    if not antialiased:
        count = length // 2
        begin = min(start // 2, count - 1)  # the last pixel of an odd side is not looked at
        out = begin, max(min((stop + 1) // 2, count), begin + 1)
        return _Axis(out, count, 2 * out[0], 2 * out[1])
    # output i blurs the maxima 2i-2 .. 2i, mirrored at the borders; maximum j is that of pixels j and j+1
    count, maxima = length // 2 + 1, length - 1
    begin = 0 if start <= 3 else start // 2
    end = count if stop >= length - 3 else min((stop + 1) // 2 + 1, count)
    mirrored = [_mirror(p, maxima) for p in range(2 * begin - 2, 2 * end - 1)]
    low = min(mirrored)
    order = tuple(p - low for p in mirrored)
    return _Axis((begin, end), count, low, max(mirrored) + 2, order=order)


def _mirror(position: int, length: int) -> int:
    return length - 1 - abs(length - 1 - abs(position))


def _in_small(positions: Tensor, length: int, small_length: int) -> Tensor:
    """Returns where positions of a black picture's map lie in the small one's: from the nearer end, at most half."""
    half = small_length // 2
    from_end = (positions - (length - small_length)).clamp(min=half)
    return torch.where(positions < half, positions, from_end)
