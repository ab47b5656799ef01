"""Two people who cross are not taken for one; who turns, is lit otherwise or filmed by a camera that adapts is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from occfusion.errors import DataError
from occfusion.footage.identity import (
    OTHER,
    appearance,
    changes_of_person,
    first_of_another,
    gains_of,
    require_one_person,
)  # fmt: skip

FRAMES, HEIGHT, WIDTH = 24, 160, 120
SECONDS = np.arange(FRAMES) / 15
BARE = ((190, 150, 130), (190, 150, 130), (25, 25, 30))
DRESSED = ((230, 225, 220), (60, 80, 130), (60, 80, 130))
BACK = ((150, 40, 40), (150, 40, 40), (25, 25, 30))
"""Colours of arms, top and trousers."""


def person(colours, place, rng):
    """Returns a picture `[H, W, 3]` of somebody before a room, and the mask."""
    picture = np.full((HEIGHT, WIDTH, 3), (120, 125, 110), np.uint8)
    cv2.rectangle(picture, (0, 110), (WIDTH, HEIGHT), (70, 60, 50), -1)
    cv2.rectangle(picture, (80, 10), (110, 50), (180, 170, 60), -1)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    parts = [((-18, 40), (18, 60)), ((-11, 30), (11, 80)), ((-11, 80), (11, 140))]
    for (low, high), colour in zip(parts, colours, strict=True):
        ends = (place + low[0], low[1]), (place + high[0], high[1])
        cv2.rectangle(picture, *ends, colour, -1)
        cv2.rectangle(mask, *ends, 1, -1)
    noisy = np.clip(picture + rng.normal(0, 6, picture.shape), 0, 255).astype(np.uint8)
    return noisy, mask > 0


def clip(who, gains=None):
    """Returns pictures and masks of frames of somebody each, with a gain of the camera each."""
    rng = np.random.default_rng(0)
    pairs = [person(colours, 40 + k, rng) for k, colours in enumerate(who)]
    gains = [np.ones(3)] * len(who) if gains is None else gains
    pictures = [
        np.clip(picture * gain, 0, 255).astype(np.uint8)
        for (picture, _), gain in zip(pairs, gains, strict=True)
    ]
    return pictures, [mask for _, mask in pairs]


def plain_colours(pictures, masks):
    """Returns how many pixels of each colour masks show, as filmed, `[N, C]`."""
    return np.array([appearance(p, m, np.ones(3)) for p, m in zip(pictures, masks, strict=True)])


def test_a_change_of_person_is_named_with_the_longest_part():
    pictures, masks = clip([BARE] * 15 + [DRESSED] * 9)
    with pytest.raises(DataError, match=r"from frame 130 on.*--start 100 --stop 129") as error:
        require_one_person(pictures, masks, range(100, 100 + 2 * FRAMES, 2), SECONDS)
    assert "--masks" in str(error.value)


def test_frames_of_both_and_frames_without_anybody_lie_between():
    pictures, masks = clip([BARE] * 12 + [DRESSED] * 12)
    masks[11] = masks[11] | np.roll(masks[11], 30, axis=1)
    masks[12] = np.zeros_like(masks[12])
    with pytest.raises(DataError, match="somebody else"):
        require_one_person(pictures, masks, range(FRAMES), SECONDS)


def test_two_changes_are_both_named():
    pictures, masks = clip([BARE] * 8 + [DRESSED] * 8 + [BARE] * 8)
    with pytest.raises(DataError, match="from frame 8, 16 on"):
        require_one_person(pictures, masks, range(FRAMES), SECONDS)


@pytest.mark.parametrize("gain", [(0.6, 0.6, 0.6), (1.15, 1.0, 0.8), (0.8, 1.0, 1.15)])
def test_a_camera_that_adapts_at_once_changes_nobody(gain):
    half = FRAMES // 2
    gains = [np.ones(3)] * half + [np.array(gain)] * half
    pictures, masks = clip([BARE] * FRAMES, gains)
    assert first_of_another(pictures, masks, SECONDS) == []
    np.testing.assert_allclose(gains_of(pictures, masks)[-1] / gains_of(pictures, masks)[0], gain, rtol=0.03)
    assert changes_of_person(plain_colours(pictures, masks), SECONDS) == [half]  # what the room takes out


def test_who_turns_shows_the_back_little_by_little():
    rng, pictures, masks = np.random.default_rng(0), [], []
    for k in range(FRAMES):
        (front, mask), (back, _) = (person(colours, 40 + k, rng) for colours in (BARE, BACK))
        edge = 40 + k - 18 + round(36 * np.clip((k - 6) / 12, 0, 1))  # in 0.8 seconds
        shown = np.where(np.arange(WIDTH)[None, :, None] < edge, back, front)
        pictures.append(shown)
        masks.append(mask)
    assert first_of_another(pictures, masks, SECONDS) == []
    ends = [*range(6), *range(FRAMES - 6, FRAMES)]  # the turn left out
    at_once = first_of_another([pictures[k] for k in ends], [masks[k] for k in ends], SECONDS[:12])
    assert at_once == [6]


def test_where_colours_change_all_the_time_they_tell_nothing():
    pictures, masks = clip([BARE, BACK] * 6 + [DRESSED] * 12)
    assert first_of_another(pictures, masks, SECONDS) == []
    pictures, masks = clip([BARE] * 12 + [DRESSED] * 12)
    assert first_of_another(pictures, masks, SECONDS) == [12]


def test_frames_far_apart_in_time_tell_nothing():
    pictures, masks = clip([BARE] * 12 + [BACK] * 12)
    require_one_person(pictures, masks, range(FRAMES), np.arange(FRAMES) / 2)
    with pytest.raises(DataError, match="somebody else"):
        require_one_person(pictures, masks, range(FRAMES), SECONDS)


def test_few_frames_and_small_masks_tell_nothing():
    pictures, masks = clip([BARE] * 3 + [DRESSED] * 2)
    require_one_person(pictures, masks, range(5), SECONDS)
    assert appearance(pictures[0], np.zeros((HEIGHT, WIDTH), bool), np.ones(3)) is None
    require_one_person(pictures, [np.zeros((HEIGHT, WIDTH), bool)] * 5, range(5), SECONDS)
    assert changes_of_person(np.zeros((0, 864)), np.zeros(0)) == []


def test_a_part_of_the_person_is_nobody_else():
    """From an arm alone to the trunk alone, as behind a tree: colours have nothing in common."""
    pictures, masks = clip([DRESSED] * FRAMES)
    for k in range(6, 18):
        beside = np.arange(WIDTH) < 40 + k - 12
        masks[k] &= beside if k < 12 else ~beside & (np.arange(HEIGHT) > 62)[:, None]
    require_one_person(pictures, masks, range(FRAMES), SECONDS)
    assert changes_of_person(plain_colours(pictures, masks), SECONDS) == [12]  # by colours alone


@pytest.mark.parametrize("emerges", [False, True])
@pytest.mark.parametrize("part", [slice(80, None), slice(0, 80)])
def test_who_is_hidden_at_once_is_the_same_person(part, emerges):
    pictures, masks = clip([BARE] * FRAMES)
    for k in range(FRAMES):
        if (k < FRAMES // 2) == emerges:
            pictures[k][part, 15 + k : 65 + k] = 90
            masks[k][part] = False
    assert first_of_another(pictures, masks, SECONDS) == []
    rows = np.sqrt(plain_colours(pictures, masks))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    assert 1.0 - rows[0] @ rows[-1] > OTHER  # by the distance alone it would be another


def test_colours_are_counted_against_an_oracle():
    """Two colours of known areas: the distance of two masks follows from the shares."""
    picture = np.full((320, 320, 3), 110, np.uint8)
    picture[100:200, 100:150], picture[100:200, 150:200] = (200, 40, 40), (40, 40, 200)
    masks = [np.zeros((320, 320), bool) for _ in range(2)]
    masks[0][100:200, 100:200], masks[1][100:200, 100:150] = True, True
    both, red = (appearance(picture, mask, np.ones(3)) for mask in masks)
    assert both is not None and red is not None
    np.testing.assert_allclose(
        [both.sum(), red.sum()], [96 * 96, 96 * 46], rtol=0.02
    )  # a rim of 2 px is left out
    overlap = (np.sqrt(both / both.sum()) * np.sqrt(red / red.sum())).sum()
    assert abs(overlap - np.sqrt(0.5)) < 0.02
