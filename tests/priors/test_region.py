"""The region that is inpainted: where it lies, and the way there and back."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from made_up_person import made_up_camera
from occfusion.priors.sd15.region import Region

sides = st.integers(24, 700)


@given(width=sides, height=sides, seed=st.integers(0, 10_000), resolution=st.sampled_from([0, 64, 512]))
def test_holds_the_body_and_its_margin_in_multiples_of_eight(
    width: int, height: int, seed: int, resolution: int
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform((-0.2 * width, -0.2 * height), (1.2 * width, 1.2 * height), (5, 2))
    region = Region.around(points, (width, height), 20, resolution)
    low, high = points.min(axis=0), points.max(axis=0)
    if (high <= 0).any() or (low >= (width, height)).any():
        assert region is None
        return
    assert region is not None
    sizes = (region.width, region.height, region.work_width, region.work_height)
    assert all(size % 8 == 0 and size > 0 for size in sizes)
    assert max(sizes[2:]) == (resolution or max(sizes[:2]))
    start, end = np.array([region.x, region.y]), np.array([region.x + region.width, region.y + region.height])
    assert (start >= 0).all()
    assert (start <= np.maximum(low - 20, 0)).all()
    assert (end >= np.minimum(high + 20, (width, height))).all()
    assert (end - np.array([width, height]) < 8).all()


@pytest.mark.parametrize("points", [np.zeros((0, 2)), np.full((4, 2), -5.0), np.full((4, 2), 500.0)])
def test_no_region_without_a_body_in_the_picture(points: np.ndarray) -> None:
    assert Region.around(points, (100, 100), 20) is None


def test_own_size_there_and_back_changes_nothing() -> None:
    picture = np.random.default_rng(0).random((50, 61), np.float32)
    region = Region.around(np.array([(25.0, 20.0), (60.0, 49.0)]), (61, 50), 5)
    assert region is not None
    back = region.put(region.take(picture, outside=1.0), 61, 50)
    inside = np.zeros((50, 61), bool)
    inside[region.y : region.y + region.height, region.x : region.x + region.width] = True
    np.testing.assert_array_equal(back, np.where(inside, picture, 0.0))
    assert inside[15:, 20:].all()


def test_scaled_there_and_back_keeps_a_smooth_picture() -> None:
    y, x = np.mgrid[:60, :60].astype(np.float32)
    picture = (0.5 + 0.4 * np.sin(x / 9) * np.cos(y / 11)).astype(np.float32)
    region = Region.around(np.array([(20.0, 10.0), (40.0, 50.0)]), (60, 60), 4, 512)
    assert region is not None and region.work_height == 512
    back = region.put(region.take(picture, outside=1.0), 60, 60)
    assert abs(back - picture)[12:48, 22:38].max() < 0.01


def test_beyond_the_picture_is_the_given_value() -> None:
    region = Region.around(np.array([(0.0, 0.0), (13.0, 13.0)]), (13, 13), 20)
    assert region == Region(0, 0, 16, 16, 16, 16)
    window = region.take(np.zeros((13, 13, 3), np.float32), outside=1.0)
    assert window.shape == (16, 16, 3)
    assert (window[13:] == 1).all() and (window[:, 13:] == 1).all() and not window[:13, :13].any()


def test_its_camera_sees_what_it_takes() -> None:
    camera = made_up_camera(96)
    region = Region.around(np.array([(30.0, 20.0), (70.0, 80.0)]), (96, 96), 7, 128)
    assert region is not None
    point = torch.tensor([0.3, -0.2, 4.0], dtype=torch.float64)
    before, after = (K @ point / point[2] for K in (camera.K, region.camera(camera).K))
    expected = (before[:2].numpy() - (region.x, region.y)) * region.scale
    np.testing.assert_allclose(after[:2], expected, atol=1e-9)
