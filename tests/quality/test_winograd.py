"""Winograd's convolution of chosen tiles against the plain sum in double precision."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from occfusion.perceptual.winograd import TileConvolution, grouped, tiles_of

ERROR = 2e-5
"""Of the largest result."""


def convolve(
    x: Tensor, weight: Tensor, bias: Tensor, chosen: Tensor, corner: tuple[int, int] = (0, 0)
) -> Tensor:
    """The result in the box of `chosen` whose corner is given; NaN where nothing was written."""
    _, _, height, width = x.shape
    whole = np.ones((height, width), dtype=bool)
    nothing = np.empty((0, 0, weight.shape[1] // 64, 64), np.float32)
    rows, columns = np.zeros(height, np.int64), np.zeros(width, np.int64)
    values = grouped(x.permute(0, 2, 3, 1).contiguous())
    out = torch.full((len(x), *chosen.shape, len(bias)), float("nan"))
    source = (values, whole, nothing, rows, columns, np.zeros(2, np.int64))
    TileConvolution(weight, bias).write(source, chosen, np.array(corner), grouped(out))
    return out.permute(0, 3, 1, 2)


def layer(outgoing: int, incoming: int, scale: float = 1.0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(outgoing + incoming)
    weight = torch.randn(outgoing, incoming, 3, 3, generator=generator) * (scale / (3 * incoming**0.5))
    return weight, torch.randn(outgoing, generator=generator) * scale


def plain(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    return F.relu(F.conv2d(x.double(), weight.double(), bias.double(), padding=1))


@pytest.mark.parametrize(("incoming", "outgoing"), [(64, 64), (64, 128), (128, 64), (192, 128)])
@pytest.mark.parametrize("size", [(1, 1), (3, 5), (4, 4), (7, 30), (33, 18)])
def test_whole_maps(incoming: int, outgoing: int, size: tuple[int, int]) -> None:
    weight, bias = layer(outgoing, incoming)
    x = torch.rand(2, incoming, *size, generator=torch.Generator().manual_seed(3))
    result, truth = convolve(x, weight, bias, torch.ones(size, dtype=torch.bool)), plain(x, weight, bias)
    assert (result - truth).abs().max() <= ERROR * truth.max()
    assert (result >= 0).all()


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_extreme_sizes_of_numbers(scale: float) -> None:
    weight, bias = layer(64, 64, scale)
    x = torch.rand(1, 64, 9, 9) * scale
    result = convolve(x, weight, bias * scale, torch.ones(9, 9, dtype=torch.bool))
    truth = plain(x, weight, bias * scale)
    assert (result - truth).abs().max() <= ERROR * truth.max()


def test_what_is_not_chosen_is_not_computed() -> None:
    weight, bias = layer(64, 64)
    x = torch.rand(2, 64, 40, 30, generator=torch.Generator().manual_seed(4))
    chosen = torch.zeros(20, 17, dtype=torch.bool)
    chosen[3, 4] = chosen[19, 16] = True
    result = convolve(x, weight, bias, chosen, corner=(11, 9))
    truth = plain(x, weight, bias)[:, :, 11:31, 9:26]
    written = ~result.isnan()
    assert written[:, :, chosen].all()
    assert written[0, 0].sum() == 16 + 4, "one whole tile, and of the last what lies in the box"
    assert (result - truth)[written].abs().max() <= ERROR * truth.max()


def test_more_tiles_than_a_chunk_and_any_number_of_threads() -> None:
    weight, bias = layer(64, 64)
    x = torch.rand(1, 64, 70, 70, generator=torch.Generator().manual_seed(5))
    truth, results = plain(x, weight, bias), []
    threads = torch.get_num_threads()
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            results.append(convolve(x, weight, bias, torch.ones(70, 70, dtype=torch.bool)))
    finally:
        torch.set_num_threads(threads)
    for result in results:
        assert (result - truth).abs().max() <= ERROR * truth.max()


def test_a_number_that_is_none_stays_so() -> None:
    weight, bias = layer(64, 64)
    x = torch.rand(1, 64, 12, 12)
    x[0, 5, 6, 6] = float("nan")
    assert convolve(x, weight, bias, torch.ones(12, 12, dtype=torch.bool)).isnan().any()


def test_tiles_cover_the_mask_and_nothing_else() -> None:
    chosen = torch.zeros(9, 6, dtype=torch.bool)
    chosen[0, 0] = chosen[8, 5] = True
    assert tiles_of(chosen, 2).tolist() == [[0, 0, 0], [0, 8, 4], [1, 0, 0], [1, 8, 4]]


def test_other_counts_of_channels_are_refused() -> None:
    with pytest.raises(ValueError, match="multiples of 64, got 3 and 64"):
        TileConvolution(torch.zeros(64, 3, 3, 3), torch.zeros(64))
