"""The canvas of in-context inpainting: what stands where, and the way back into the picture."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from made_up_partial import made_up_partial, only_region, painted_like
from occfusion.inpaint.side_by_side import (
    HALVES,
    draw_side_by_side,
    put_back,
    put_side_by_side,
    right_half,
)
from occfusion.priors.sd15.region import Region, body_keypoints, body_region

PARTIAL = made_up_partial()


def region_of(partial=PARTIAL, resolution: int = 0) -> Region:
    found = body_region(partial.observation, 8)
    assert found is not None
    return found.at_work(resolution, HALVES)


def test_left_half_is_the_coarse_rendering_and_right_half_the_observation_on_white() -> None:
    region = region_of()
    side = put_side_by_side(PARTIAL, region)
    height, width = region.height, region.width
    assert side.picture.shape == (height, 2 * width, 3) and side.mask.shape == (height, 2 * width)
    rows, columns = slice(region.y, region.y + height), slice(region.x, region.x + width)
    alpha = PARTIAL.alpha[rows, columns, None]
    np.testing.assert_allclose(side.picture[:, :width], PARTIAL.coarse[rows, columns] + 1 - alpha, atol=1e-6)
    visible = PARTIAL.observation.visible[rows, columns, None]
    expected = np.where(visible, PARTIAL.observation.rgb[rows, columns], 1.0)
    np.testing.assert_array_equal(right_half(side.picture), expected)
    assert not side.mask[:, :width].any()
    np.testing.assert_array_equal(side.mask[:, width:], PARTIAL.region[rows, columns])
    assert side.mask.any() and PARTIAL.region.sum() == side.mask.sum()
    assert not PARTIAL.region[PARTIAL.alpha < 0.65].any()


@pytest.mark.parametrize("resolution", [0, 64, 256, 512])
def test_every_pixel_of_the_region_is_painted_at_any_size(resolution: int) -> None:
    region = region_of(resolution=resolution)
    side = put_side_by_side(PARTIAL, region)
    assert side.picture.shape == (region.work_height, 2 * region.work_width, 3)
    assert region.work_width % 8 == region.work_height % 8 == 0
    if resolution:
        assert max(2 * region.work_width, region.work_height) == resolution
    back = region.put(right_half(side.mask.astype(np.float32)), 96, 96)
    assert (back[PARTIAL.region] > 0).all()
    painted = np.where(right_half(side.mask)[..., None], 0.4, right_half(side.picture)).astype(np.float32)
    deep = PARTIAL.region & (PARTIAL.alpha == 1.0) & ~_near(PARTIAL.observation.visible, 2)
    deep[: int(0.2 * 96) + 2], deep[int(0.8 * 96) - 2 :] = False, False
    deep[:, : int(0.38 * 96) + 4] = False
    np.testing.assert_allclose(put_back(painted, PARTIAL, region)[deep], 0.4, atol=1e-5)


def _near(mask: np.ndarray, pixels: int) -> np.ndarray:
    found = mask.copy()
    for axis in (0, 1):
        for step in range(-pixels, pixels + 1):
            found |= np.roll(mask, step, axis)
    return found


def test_a_copied_left_half_comes_back_as_the_coarse_rendering() -> None:
    region = region_of()
    left = put_side_by_side(PARTIAL, region).picture[:, : region.work_width]
    back = put_back(left, PARTIAL, region)
    np.testing.assert_allclose(back[PARTIAL.region], PARTIAL.coarse[PARTIAL.region], atol=1e-6)


def test_each_pixel_comes_back_where_it_was_and_the_rest_is_the_person_over_black() -> None:
    region = region_of()
    painted = painted_like(0, region.height, region.width)
    back = put_back(painted, PARTIAL, region)
    solid = PARTIAL.region & (PARTIAL.alpha == 1.0)
    rows, columns = np.nonzero(solid)
    np.testing.assert_allclose(back[solid], painted[rows - region.y, columns - region.x], atol=1e-6)
    visible = PARTIAL.observation.visible
    np.testing.assert_array_equal(back[visible], PARTIAL.observation.rgb[visible])
    faint = PARTIAL.complete & ~visible & ~PARTIAL.region
    assert faint.any()
    np.testing.assert_array_equal(back[faint], PARTIAL.coarse[faint])
    assert not back[~PARTIAL.complete & ~PARTIAL.region & ~visible].any()
    without = put_back(None, PARTIAL, region)
    np.testing.assert_array_equal(without[PARTIAL.region], PARTIAL.coarse[PARTIAL.region])


def test_a_pixel_of_the_left_half_never_comes_back() -> None:
    region = region_of()
    canvas = painted_like(1, region.height, 2 * region.width)
    changed = canvas.copy()
    changed[:, : region.width] = 0.0
    back, other = (put_back(right_half(each), PARTIAL, region) for each in (canvas, changed))
    np.testing.assert_array_equal(back, other)
    changed = canvas.copy()
    solid = PARTIAL.region & (PARTIAL.alpha == 1.0)
    row, column = (int(part[5]) for part in np.nonzero(solid))
    changed[row - region.y, region.width + column - region.x] = 1.0 - changed[row - region.y, 0]
    rows, columns, _ = np.nonzero(put_back(right_half(changed), PARTIAL, region) != back)
    assert set(rows) == {row} and set(columns) == {column}


@given(
    beside=st.integers(0, 50), size=st.sampled_from([61, 96, 101]), resolution=st.sampled_from([0, 64, 160])
)
def test_a_person_at_the_border_of_the_picture(beside: int, size: int, resolution: int) -> None:
    partial = made_up_partial(size, beside=min(beside, size // 2))
    region = region_of(partial, resolution)
    side = put_side_by_side(partial, region)
    assert side.mask.shape[0] % 8 == 0 and side.mask.shape[1] % 16 == 0
    width = region.work_width
    assert not side.mask[:, :width].any()
    left = side.picture[:, :width]
    back = put_back(left, partial, region)
    assert back.shape == (size, size, 3) and np.isfinite(back).all()
    assert side.mask.any() == partial.region.any()
    if not resolution:
        np.testing.assert_allclose(back[partial.region], partial.coarse[partial.region], atol=1e-6)
    assert not back[~partial.complete & ~partial.region].any()


def test_pixels_of_the_paper_s_region_outside_the_body_s_stay_coarse() -> None:
    region = region_of()
    alpha, coarse = PARTIAL.alpha.copy(), PARTIAL.coarse.copy()
    alpha[0, 0], coarse[0, 0] = 1.0, (0.2, 0.4, 0.6)
    partial = dataclasses.replace(PARTIAL, alpha=alpha, coarse=coarse)
    assert partial.region[0, 0] and not region.inside(96, 96)[0, 0]
    back = put_back(painted_like(2, region.height, region.width), partial, region)
    np.testing.assert_array_equal(back[0, 0], coarse[0, 0])


def test_not_finite_stays_in_the_region() -> None:
    for resolution in (0, 64, 512):
        region = region_of(resolution=resolution)
        painted = np.full((region.work_height, region.work_width, 3), np.nan, np.float32)
        back = put_back(painted, PARTIAL, region)
        np.testing.assert_array_equal(np.isnan(back).all(axis=-1), PARTIAL.region)
        np.testing.assert_array_equal(np.isnan(back).any(axis=-1), PARTIAL.region)


def test_nothing_to_paint_gives_an_empty_mask() -> None:
    partial = only_region(PARTIAL, PARTIAL.observation.visible)
    assert not partial.region.any()
    assert not put_side_by_side(partial, region_of()).mask.any()


def test_skeleton_stands_in_both_halves_alike() -> None:
    partial = made_up_partial(beside=46)  # half of it beyond the left border
    for resolution in (0, 128):
        region = region_of(partial, resolution)
        canvas = draw_side_by_side(body_keypoints(partial.observation, region, 0.3), region)
        assert canvas.shape == (region.work_height, 2 * region.work_width, 3) and canvas.dtype == np.uint8
        np.testing.assert_array_equal(canvas[:, : region.work_width], right_half(canvas))
        assert canvas.any()
