import numpy as np
import pytest
import torch

from occfusion.geometry.resample import averaging_matrix, take_square
from occfusion.observation.crop import Square


@pytest.mark.parametrize(("start", "side", "size"), [(0.0, 20.0, 5), (2.3, 11.0, 4), (5.0, 3.0, 12)])
def test_rows_average_what_is_linear_between_pixel_centres(start: float, side: float, size: int) -> None:
    values = np.random.default_rng(0).uniform(size=20)
    places = np.concatenate([[-0.5], np.arange(20) + 0.5, [20.5]])
    fine = start + side * (np.arange(size * 4000) + 0.5) / (size * 4000)
    expected = np.interp(fine, places, np.pad(values, 1)).reshape(size, -1).mean(axis=1)
    found = averaging_matrix(start, side, size, 0, 20).double().numpy() @ values
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_constant_stays_inside_and_mass_is_kept() -> None:
    matrix = averaging_matrix(4.0, 12.0, 7, 0, 20)
    torch.testing.assert_close(matrix.sum(dim=1), torch.ones(7))
    assert float(averaging_matrix(-5.0, 30.0, 7, 0, 20).sum() * 30.0 / 7) == pytest.approx(20.0, rel=1e-6)


@pytest.mark.parametrize("side", [40.0, 90.0, 300.0])
def test_square_is_the_one_that_masks_are_taken_with(side: float) -> None:
    picture = np.zeros((120, 100), np.float32)
    picture[30:90, 20:70] = np.random.default_rng(1).uniform(0.5, 1.0, (60, 50))
    square = Square(12.3, 20.8, side)
    box = (15, 25, 60, 70)
    window = torch.from_numpy(picture[25:95, 15:75])
    found = take_square(window, box, square.x, square.y, square.side, 32).numpy()
    assert np.abs(found - square.take(picture, 32)).max() < 0.1
    assert np.abs(found - square.take(picture, 32)).mean() < 0.01


def test_gradient_reaches_each_pixel_by_its_share() -> None:
    window = torch.rand(10, 8, dtype=torch.float64, requires_grad=True)

    def taken(picture: torch.Tensor) -> torch.Tensor:
        return take_square(picture, (3, 2, 8, 10), 1.5, 1.0, 12.0, 5)

    assert torch.autograd.gradcheck(taken, window)
