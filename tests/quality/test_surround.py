"""Mostly black pictures: the perceptual metric computed where they are not black is that of the whole."""

import copy
import time

import pytest
import torch
from torch import Tensor

from occfusion.perceptual import PerceptualMetric, load_perceptual
from occfusion.perceptual.network import layer_shapes
from occfusion.perceptual.surround import BlackSurround, small
from occfusion.perceptual.weights import MetricWeights

Box = tuple[int, int, int, int]
RELATIVE = 1e-5
ABSOLUTE = 1e-8
"""Two pictures that hardly differ: what is left of rounding in features of length 1."""


def made_up(*, antialiased: bool, centred: bool = True) -> PerceptualMetric:
    """Random positive biases: black itself and the borders leave strong traces in all layers."""
    generator = torch.Generator().manual_seed(5)
    convolutions = {
        name: (
            torch.randn(shape, generator=generator) * (2 / (9 * shape[1])) ** 0.5,
            torch.rand(shape[0], generator=generator),
        )
        for name, shape in layer_shapes().items()
    }
    heads = [torch.rand(c, generator=generator) for c in (64, 128, 256, 512, 512)]
    return PerceptualMetric("x", MetricWeights(convolutions, heads), antialiased=antialiased, centred=centred)


def pair(height: int, width: int, box: Box) -> tuple[Tensor, Tensor]:
    x, y, w, h = box
    pictures = torch.zeros(2, height, width, 3)
    pictures[:, y : y + h, x : x + w] = torch.rand(2, h, w, 3, generator=torch.Generator().manual_seed(1))
    return pictures[0], pictures[1]


CASES = [
    (96, 120, (40, 30, 20, 30)),
    (97, 121, (41, 31, 19, 29)),  # odd sides and starts
    (98, 119, (0, 0, 17, 23)),  # in a corner
    (99, 123, (100, 80, 23, 19)),  # in the other
    (101, 97, (30, 0, 5, 101)),  # from border to border
    (110, 109, (108, 3, 1, 1)),  # one pixel in the last column, which plain pooling drops
    (110, 109, (3, 109, 1, 1)),
    (128, 64, (4, 4, 3, 3)),
    (112, 96, (2, 105, 4, 4)),
]


@pytest.mark.parametrize("antialiased", [True, False])
@pytest.mark.parametrize(("height", "width", "box"), CASES)
def test_result_is_that_of_the_whole_picture(antialiased: bool, height: int, width: int, box: Box) -> None:
    metric = made_up(antialiased=antialiased)
    a, b = pair(height, width, box)
    whole = float(metric(a, b))
    assert whole > 0
    assert float(metric.over_black(a, b)) == pytest.approx(whole, rel=RELATIVE)


@pytest.mark.parametrize("antialiased", [True, False])
@pytest.mark.parametrize(
    ("height", "width", "box"), [(401, 347, (150, 170, 40, 90)), (352, 366, (340, 300, 26, 40))]
)
def test_pictures_larger_than_the_small_black_one(
    antialiased: bool, height: int, width: int, box: Box
) -> None:
    assert small(height) < height and small(width) < width
    metric = made_up(antialiased=antialiased, centred=False)
    a, b = pair(height, width, box)
    assert float(metric.over_black(a, b)) == pytest.approx(float(metric(a, b)), rel=RELATIVE)


def test_filters_that_were_dropped_are_made_anew() -> None:
    metric = made_up(antialiased=True)
    a, b = pair(96, 120, (40, 30, 20, 30))
    before = metric.over_black(a, b)
    assert metric._surround._tiles
    metric.drop_filters()
    assert not metric._surround._tiles
    assert torch.equal(metric.over_black(a, b), before)


def test_of_black_pictures_their_rims_are_kept() -> None:
    metric = made_up(antialiased=True)
    a, b = pair(336, 336, (100, 90, 120, 60))
    assert float(metric.over_black(a, b)) == pytest.approx(float(metric(a, b)), rel=RELATIVE)
    (maps,) = metric._surround._black.values()
    assert (
        max(max(known.shape[:2]) for known in maps) <= 2 * 10
    )  # felt 9 positions deep at most, and one more
    assert sum(known.nbytes for known in maps) < 6e6  # whole maps: 140 MB


def test_published_weights_both_calls_and_other_sizes_in_turn() -> None:
    metric = load_perceptual("stlpips")
    for metric_ in (metric, metric.with_unit_inputs(), metric):
        for height, width, box in CASES[:2]:
            a, b = pair(height, width, box)
            assert float(metric_.over_black(a, b)) == pytest.approx(float(metric_(a, b)), rel=RELATIVE)


class Raced(BlackSurround):
    """What it keeps is gone at once, as where another thread has just put pictures of another size there."""

    _black = property(lambda self: {}, lambda self, value: None)


def test_threads_with_pictures_of_other_sizes_do_no_harm() -> None:
    metric = made_up(antialiased=True)
    metric._surround = Raced(metric.network)
    a, b = pair(*CASES[0])
    assert float(metric.over_black(a, b)) == pytest.approx(float(metric(a, b)), rel=RELATIVE)


@pytest.mark.parametrize("share", [0.3, 0.01, 1e-4])
@pytest.mark.parametrize(("height", "width", "box"), [*CASES[:4], (120, 110, (3, 3, 100, 110))])
def test_pictures_that_hardly_differ_are_like_in_double_precision(
    height: int, width: int, box: Box, share: float
) -> None:
    metric = load_perceptual("stlpips")
    a, b = pair(height, width, box)
    b = a + share * (b - a)
    truth = float(copy.deepcopy(metric).double()(a.double(), b.double()))
    assert float(metric.over_black(a, b)) == pytest.approx(truth, rel=RELATIVE, abs=ABSOLUTE)


def test_separate_lit_parts_and_a_ring() -> None:
    """Regions that grow together layer by layer, and a hole that closes."""
    metric = made_up(antialiased=True)
    a, b = (torch.zeros(200, 170, 3) for _ in range(2))
    for y, x in ((5, 5), (60, 20), (61, 150), (190, 100)):
        a[y, x], b[y, x + 1] = 1.0, 0.5
    assert float(metric.over_black(a, b)) == pytest.approx(float(metric(a, b)), rel=RELATIVE)
    a[40:160, 30:140], a[50:150, 40:130] = 0.7, 0.0
    assert float(metric.over_black(a, b)) == pytest.approx(float(metric(a, b)), rel=RELATIVE)


def test_other_types_and_devices_are_computed_plainly() -> None:
    metric = copy.deepcopy(load_perceptual("stlpips")).double()
    a, b = pair(96, 120, (40, 30, 20, 30))
    assert float(metric.over_black(a.double(), b.double())) == float(metric(a.double(), b.double()))


def test_only_what_is_lit_is_computed_where_that_pays() -> None:
    metric = made_up(antialiased=True)
    black = torch.zeros(80, 80, 3)
    assert float(metric.over_black(black, black)) == 0.0
    lit, other = torch.rand(2, 80, 80, 3)
    assert float(metric.over_black(lit, other)) == float(metric(lit, other))
    not_a_number = black.clone()
    not_a_number[3, 3] = float("nan")
    assert torch.isnan(metric.over_black(not_a_number, black))
    with pytest.raises(ValueError, match="differ in shape"):
        metric.over_black(black, black[:70])


def test_time_follows_the_lit_part() -> None:
    metric = load_perceptual("stlpips")
    a, b = pair(384, 384, (160, 120, 60, 140))
    metric.over_black(a, b)  # the black picture

    def seconds(call: object) -> float:
        best = 1e9
        for _ in range(2):
            started = time.perf_counter()
            call(a, b)  # type: ignore[operator]
            best = min(best, time.perf_counter() - started)
        return best

    sparse, whole = seconds(metric.over_black), seconds(metric)
    print(f"{sparse:.2f} s against {whole:.2f} s")
    assert sparse < 0.7 * whole
