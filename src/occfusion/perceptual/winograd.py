"""3x3 convolutions of chosen 4x4 tiles with a quarter of the multiplications, float32 on a CPU.

Winograd's F(4 x 4, 3 x 3): Lavin and Gray, CVPR 2016, section 4. A 4 x 4 tile of the result needs a 6 x 6 tile of the
input, D. With the constant matrices B, G and A of that paper it is A^T [(G w G^T) * (B^T D B)] A, summed over the
input's channels: 36 products where the plain sum has 144. The sums over channels are matrix products of many tiles at
once. Results agree with the plain sum to about 1e-5 of the largest.

Only figures are computed by it (`surround`), where it pays: a step's term takes torch's convolutions, which reach 86 to
91 % of its speed. The numbers are in `docs/reference/bench.md`.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from occfusion.cpu.compilation import run_parts
from occfusion.perceptual.kernels import LANES, SPACE, finish_tiles, transform_tiles

TILE = 4
WORDS = 300_000
"""Numbers of a chunk's transformed tiles: what the second cache of a core holds."""
LEAST_CHUNK = 96
"""Tiles that a chunk has at least: rows enough for a matrix product to be worth reading its filters."""
_G = (
    (1 / 4, 0.0, 0.0),
    (-1 / 6, -1 / 6, -1 / 6),
    (-1 / 6, 1 / 6, -1 / 6),
    (1 / 24, 1 / 12, 1 / 6),
    (1 / 24, -1 / 12, 1 / 6),
    (0.0, 0.0, 1.0),
)


class TileConvolution:
    """A 3x3 convolution with bias, rectified.

    Args:
        weight: `[K, C, 3, 3]`; both channel counts multiples of 64.
        bias: `[K]`.

    Raises:
        ValueError: other counts of channels.
    """

    def __init__(self, weight: Tensor, bias: Tensor) -> None:
        outgoing, incoming = weight.shape[:2]
        if incoming % LANES or outgoing % LANES:
            raise ValueError(f"channels come in multiples of {LANES}, got {incoming} and {outgoing}")
        g = torch.tensor(_G)
        by_place = weight.permute(2, 3, 1, 0).reshape(9, -1)  # so that the product lies as it is read
        self._filters = (torch.kron(g, g) @ by_place).view(36, incoming, outgoing)
        self._bias = grouped(bias.contiguous())

    def write(
        self, source: tuple[np.ndarray, ...], chosen: Tensor, corner: np.ndarray, out: np.ndarray
    ) -> None:
        """Writes the result wherever it is chosen, and here and there around.

        Args:
            source: the first six arguments of `kernels.transform_tiles`; beyond the map's borders is 0.
            chosen: bool `[h, w]`.
            corner: row and column of `out` in the whole map, int64 `[2]`.
            out: `[N, h, w, K/64, 64]`.
        """
        incoming, outgoing = self._filters.shape[1:]
        tiles = tiles_of(chosen, len(out)) + torch.tensor([0, *corner.tolist()])
        # an odd number of rows: strides by powers of two would all fall on the same lines of a cache
        size = min(max(WORDS // (36 * (incoming + outgoing)), LEAST_CHUNK), len(tiles)) | 1
        spaces = working_space()
        inputs, products = torch.empty(36, size, incoming), torch.empty(36, size, outgoing)
        for chunk in tiles.split(size):
            count, places = len(chunk), chunk.numpy()
            run_parts(transform_tiles, *source, places, grouped(inputs), spaces)
            torch.bmm(inputs[:, :count], self._filters, out=products[:, :count])
            run_parts(finish_tiles, grouped(products), places, self._bias, corner, out, spaces)


def working_space() -> np.ndarray:
    """Returns what the kernels want of it."""
    return np.empty((torch.get_num_threads(), SPACE), np.float32)


def grouped(x: Tensor) -> np.ndarray:
    """Returns the numbers of a tensor `[..., C]` as the kernels take them, `[..., C/64, 64]`."""
    array: np.ndarray = x.unflatten(-1, (-1, LANES)).numpy()
    return array


def tiles_of(chosen: Tensor, pictures: int) -> Tensor:
    """Returns picture, row and column of the 4x4 tiles that cover a mask `[h, w]`, of each of so many pictures."""
    height, width = chosen.shape
    rows, columns = -(-height // TILE), -(-width // TILE)
    whole = chosen.new_zeros(rows * TILE, columns * TILE)
    whole[:height, :width] = chosen
    places = whole.view(rows, TILE, columns, TILE).any(dim=3).any(dim=1).nonzero() * TILE
    number = torch.arange(pictures).repeat_interleave(len(places))
    return torch.cat([number[:, None], places.repeat(pictures, 1)], dim=1)
