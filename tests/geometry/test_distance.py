"""Distances in masks against all pairs of pixels."""

import numpy as np
import pytest
from numpy.typing import NDArray

from occfusion.geometry.distance import nearest_set, signed_distance


def blob(seed: int, height: int = 37, width: int = 52) -> NDArray[np.bool_]:
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width]
    made = np.zeros((height, width), bool)
    for _ in range(4):
        row, column, radius = rng.uniform(0, height), rng.uniform(0, width), rng.uniform(2, 9)
        made |= np.hypot(rows - row, columns - column) < radius
    return made


def away(mask: NDArray[np.bool_]) -> NDArray[np.floating]:
    """Distance of each pixel to each set one, `[H, W, set]`: the oracle."""
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]]
    set_rows, set_columns = np.nonzero(mask)
    return np.hypot(rows[..., None] - set_rows, columns[..., None] - set_columns)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("window", "error"), [(3, 0.08), (5, 0.025)])
def test_the_distance_is_that_to_the_nearest_pixel_of_the_other_kind(
    seed: int, window: int, error: float
) -> None:
    mask = blob(seed)
    true = np.where(mask, away(~mask).min(axis=-1), -away(mask).min(axis=-1))
    found = signed_distance(mask, window)
    assert found.dtype == np.float32
    assert np.array_equal(found > 0, mask)
    assert np.abs(found / true - 1.0).max() < error


def test_the_inverse_has_the_other_sign() -> None:
    mask = blob(7)
    assert np.array_equal(signed_distance(~mask), -signed_distance(mask))


@pytest.mark.parametrize("value", [False, True])
def test_without_an_edge_all_is_far(value: bool) -> None:
    found = signed_distance(np.full((5, 9), value))
    assert np.isfinite(found).all()
    assert (found > 9).all() if value else (found < -9).all()


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_set_pixel_is_set_and_no_other_is_clearly_nearer(seed: int) -> None:
    mask = blob(seed)
    index = nearest_set(mask)
    assert mask.ravel()[index].all()
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]]
    distance = np.hypot(rows - index // mask.shape[1], columns - index % mask.shape[1])
    assert (distance <= 1.05 * away(mask).min(axis=-1) + 1e-9).all()
    assert np.array_equal(index[mask], np.flatnonzero(mask))


def test_one_pixel_is_the_nearest_of_all_and_none_is_refused() -> None:
    mask = np.zeros((4, 6), bool)
    mask[2, 5] = True
    assert (nearest_set(mask) == 17).all()
    with pytest.raises(ValueError, match="no pixel of the mask is set"):
        nearest_set(np.zeros((4, 6), bool))
