"""The network on the part of mostly black pictures that is not black; what is left out is known beforehand.

Far from any lit pixel the activations are those of an entirely black picture. They depend on the distance to the
picture's borders alone, so they are computed once on a small black picture, and each layer is evaluated only where
a lit pixel can be felt: that region grows by one position with each convolution and halves with each pooling.
Convolutions are Winograd's (`winograd`). Float32 on a CPU. The same in torch's convolutions takes 2.5 times as long,
the whole pictures 4 to 7 times (`docs/reference/bench.md`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from occfusion.cpu.compilation import run_parts
from occfusion.perceptual.kernels import LANES, pool_places, sum_distances
from occfusion.perceptual.network import BLOCKS, VggFeatures, layer_shapes
from occfusion.perceptual.winograd import TileConvolution, working_space

SMALL = 320
"""Least side in pixels of the small black picture. The borders are felt 8 positions deep in the last block, that is
128 px, so that more than 32 px in the middle feel none of them."""
PHASE = 16
"""Four poolings: sides that differ by a multiple of 16 px end alike."""
POOL = "pool"
LAST = {f"conv{number}_{len(block)}" for number, block in enumerate(BLOCKS, 1)}
Array = np.ndarray


@dataclass(frozen=True)
class Map:
    """One step's activations of some pictures, held where they can differ from those of a black picture.

    Attributes:
        values: the box that holds all chosen positions, `[N, h, w, C/64, 64]`.
        chosen: which of its positions count, bool `[h, w]`.
        known: the rim of the black picture's map, `[h', w', C/64, 64]`.
        rows: for each row of the whole map the one of `known` that is like it, int64 `[H]`.
        columns: the same for columns, `[W]`.
        corner: row and column of the box, int64 `[2]`.
    """

    values: Array
    chosen: Array
    known: Array
    rows: Array
    columns: Array
    corner: Array

    @property
    def positions(self) -> int:
        """How many positions the whole map has."""
        return len(self.rows) * len(self.columns)

    def source(self) -> tuple[Array, ...]:
        """Returns what the kernels read, in their order."""
        return self.values, self.chosen, self.known, self.rows, self.columns, self.corner


class BlackSurround:
    """Evaluates a network on pictures that are mostly black; keeps what it knows of black pictures.

    Args:
        network: the trunk; frozen.
    """

    def __init__(self, network: VggFeatures) -> None:
        self._network = network
        self._black: dict[tuple[object, ...], list[Array]] = {}
        self._tiles: dict[str, TileConvolution] = {}

    def __deepcopy__(self, memo: dict[int, object]) -> BlackSurround:
        copied: VggFeatures = memo.get(id(self._network), self._network)  # type: ignore[assignment]
        return BlackSurround(copied)

    def drop_filters(self) -> None:
        """Drops transformed filters, 235 MB, which are made anew where they are needed."""
        self._tiles = {}

    def parts(self, pictures: Tensor, lit: Tensor, black: float) -> Iterator[Map]:
        """Yields the last activations of the five blocks, which are large and dropped when the next are asked for.

        Args:
            pictures: as the network takes them, float32 `[N, 3, H, W]`.
            lit: bool `[H, W]`, not all False; elsewhere all pictures are black. All True: nothing is known.
            black: the value of black.
        """
        known = None if bool(lit.all()) else self._maps_of_black(lit.shape[0], lit.shape[1], black)
        felt, current = lit, None
        for number, step in enumerate(steps()):
            felt = self._network.reach(felt, pools=step == POOL)
            current = self._step(step, current, pictures, felt, None if known is None else known[number])
            if step in LAST:
                yield current

    def _step(
        self, step: str, before: Map | None, pictures: Tensor, felt: Tensor, known: Array | None
    ) -> Map:
        (top, bottom), (left, right) = _extent(felt.any(dim=1)), _extent(felt.any(dim=0))
        chosen = felt[top:bottom, left:right].contiguous()
        groups = (
            before.values.shape[3] if before and step == POOL else len(self._network.layer(step)[1]) // LANES
        )
        if before is None:  # three channels: nothing to be gained
            values = self._first(pictures, (top, bottom), (left, right), step)
        else:
            values = np.empty((len(pictures), bottom - top, right - left, groups, LANES), np.float32)
        height, width = felt.shape
        if known is None:
            known = np.empty((0, 0, groups, LANES), np.float32)
            rows, columns = np.zeros(height, np.int64), np.zeros(width, np.int64)
        else:
            rows, columns = (_in_small(n, m) for n, m in zip(felt.shape, known.shape, strict=False))
        result = Map(values, chosen.numpy(), known, rows, columns, np.array([top, left]))
        if before is not None and step == POOL:
            places = chosen.nonzero().numpy() + result.corner
            y_reads, x_reads = (
                self._reads(len(n), m) for n, m in ((before.rows, height), (before.columns, width))
            )
            run_parts(
                pool_places,
                *before.source(),
                places,
                y_reads,
                x_reads,
                result.corner,
                values,
                working_space(),
            )
        elif before is not None:
            if step not in self._tiles:
                self._tiles[step] = TileConvolution(*self._network.layer(step))
            self._tiles[step].write(before.source(), chosen, result.corner, values)
        return result

    def _first(self, pictures: Tensor, rows: tuple[int, int], columns: tuple[int, int], step: str) -> Array:
        """Returns the first convolution of the pictures in a box."""
        whole = F.pad(self._network.whiten(pictures), (1, 1, 1, 1))
        box = whole[:, :, rows[0] : rows[1] + 2, columns[0] : columns[1] + 2]
        values = self._network.convolve(box, step, padding=0).permute(0, 2, 3, 1).contiguous()
        return values.unflatten(3, (-1, LANES)).numpy()

    def _reads(self, length: int, results: int) -> Array:
        """Returns which positions of a line each result of a pooling looks at, as `pool_places` takes them."""
        numbers = np.arange(results)[:, None]
        if self._network.antialiased:  # the maxima are mirrored at the ends, as a whole
            last = length - 2
            first = last - np.abs(last - np.abs(2 * numbers - 2 + np.arange(3)))
        else:
            first = np.repeat(2 * numbers, 3, axis=1)
        return np.stack([first, first + 1], axis=2).reshape(results, 6)

    def _maps_of_black(self, height: int, width: int, black: float) -> list[Array]:
        """Returns the rim of every step's map of a black picture `[h, w, C/64, 64]`: all that differs within it."""
        key = small(height), small(width), black
        maps = self._black.get(key)
        if maps is None:
            pictures = torch.full((1, 3, *key[:2]), black)
            felt, current, maps = torch.ones(key[:2], dtype=torch.bool), None, list[Array]()
            deep = 0
            for step in steps():
                felt = self._network.reach(felt, pools=step == POOL)
                current = self._step(step, current, pictures, felt, None)
                deep = deep // 2 + 2 if step == POOL else deep + 1
                maps.append(_rim(current.values[0], deep))
            self._black = {key: maps}  # pictures of one evaluation are mostly of one size
        return maps


def steps() -> list[str]:
    """Returns the network's steps in order: names of convolutions, and `pool`."""
    names: list[str] = []
    for number, block in enumerate(BLOCKS, 1):
        names += [POOL] * (number > 1) + [f"conv{number}_{part}" for part, _ in enumerate(block, 1)]
    return names


def small(length: int) -> int:
    """Returns the side of the small black picture that stands for one of `length` px."""
    return length if length < SMALL + PHASE else SMALL + (length - SMALL) % PHASE


def mean_distance(features: Map, head: Tensor, floor: float) -> float:
    """Returns the mean over all positions of two pictures' distance; it is 0 where nothing is chosen."""
    sums = np.zeros(features.values.shape[1])
    weights = head.view(-1, LANES).numpy()
    run_parts(
        sum_distances, features.values, features.chosen, weights, np.float32(floor), sums, working_space()
    )
    return float(sums.sum()) / features.positions


def warm_up() -> None:
    """Compiles the kernels, or loads them from the cache: by a network of zeros and two small pictures, a pixel lit."""
    weights = {name: (torch.zeros(shape), torch.zeros(shape[0])) for name, shape in layer_shapes().items()}
    side, network = 2 * PHASE, VggFeatures(weights, antialiased=True)
    lit = torch.zeros(side, side, dtype=torch.bool)
    lit[PHASE, PHASE] = True
    for part in BlackSurround(network).parts(torch.zeros(2, 3, side, side), lit, 0.0):
        mean_distance(part, torch.zeros(part.values.shape[3] * LANES), 1.0)


def _extent(used: Tensor) -> tuple[int, int]:
    """Returns the first True and behind the last one."""
    places = used.nonzero()
    return int(places[0]), int(places[-1]) + 1


def _rim(values: Array, deep: int) -> Array:
    """Returns a black picture's map `[h, w, ...]` without the middle, which is the same everywhere.

    Args:
        values: the whole map.
        deep: how many positions the borders are felt; one more is kept of the middle, at each end.
    """
    for axis, length in enumerate(values.shape[:2]):
        if length > 2 * (deep + 1):
            ends = np.r_[: deep + 1, length - deep - 1 : length]
            values = np.take(values, ends, axis=axis)
    return values


def _in_small(length: int, small_length: int) -> Array:
    """Returns where a black picture's positions lie in the small one's: from the nearer end, at most half."""
    positions, half = np.arange(length), small_length // 2
    from_end = np.maximum(positions - (length - small_length), half)
    return np.where(positions < half, positions, from_end)
