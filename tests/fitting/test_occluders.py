"""What hides a person is told from background where the mask ends inside of the body, and nowhere else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from occfusion.fitting.occluders import found_occluders
from occfusion.fitting.quality import posed, silhouette
from occfusion.fitting.solver import Solution
from occfusion.human import embedded_body

SHAPE, FRAMES = (256, 192), 5
K = np.array([[230.0, 0, 96], [0, 230.0, 128], [0, 0, 1]])


@pytest.fixture(scope="module")
def body():
    return embedded_body()


@pytest.fixture(scope="module")
def solution() -> Solution:
    pose = np.zeros((FRAMES, 69))
    pose[:, 3 * 15 + 2], pose[:, 3 * 16 + 2] = -1.1, 1.1  # arms down
    place = np.column_stack([0.02 * np.arange(FRAMES), np.full(FRAMES, 0.3), np.full(FRAMES, 2.4)])
    return Solution(np.zeros(10), np.tile([np.pi, 0, 0], (FRAMES, 1)), pose, place, K)


@pytest.fixture(scope="module")
def whole(body, solution) -> list[np.ndarray]:
    faces = body.faces.numpy()
    return [silhouette(vertices, K, faces, SHAPE) for vertices, _ in posed(body, solution)]


def test_a_post_before_the_person_is_found(body, solution, whole):
    post = np.zeros(SHAPE, bool)
    post[:, 90:112] = True
    masks = [mask & ~post for mask in whole]
    found = found_occluders(body, solution, masks)
    assert found is not None
    for cover, mask, full in zip(found, masks, whole, strict=True):
        hidden = full & post
        assert (cover & hidden).sum() > 0.95 * hidden.sum()
        assert not (cover & mask).any()
        # beside the post by the pixel that pieces are grown by, and no more
        assert (cover & ~cv2.dilate(post.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)).sum() == 0


def test_legs_behind_a_table_are_found(body, solution, whole):
    table = np.zeros(SHAPE, bool)
    table[150:] = True
    found = found_occluders(body, solution, [mask & ~table for mask in whole])
    assert found is not None
    for cover, full in zip(found, whole, strict=True):  # hands that hang behind it are too thin to tell
        assert (cover & full & table).sum() > 0.85 * (full & table).sum()


@pytest.mark.parametrize("shift", [(0, 0), (2, 0), (-2, 1), (0, 3)])
def test_a_body_a_little_off_its_mask_hides_behind_nothing(body, solution, whole, shift):
    masks = [np.roll(mask, shift, axis=(1, 0)) for mask in whole]
    assert found_occluders(body, solution, masks) is None


def test_clothes_and_thinner_masks_are_no_occluders(body, solution, whole):
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    for change in (cv2.erode, cv2.dilate):
        masks = [change(mask.astype(np.uint8), disc) > 0 for mask in whole]
        assert found_occluders(body, solution, masks) is None


def test_what_one_frame_alone_misses_is_a_bad_mask(body, solution, whole):
    post = np.zeros(SHAPE, bool)
    post[:, 90:112] = True
    masks = [mask & ~post if k == 2 else mask for k, mask in enumerate(whole)]
    assert found_occluders(body, solution, masks) is None
    masks = [mask & ~post if k in (2, 3) else mask for k, mask in enumerate(whole)]
    found = found_occluders(body, solution, masks)
    assert found is not None and [bool(cover.any()) for cover in found] == [False, False, True, True, False]


def test_frames_without_a_mask_say_nothing(body, solution, whole):
    assert found_occluders(body, solution, [np.zeros(SHAPE, bool)] * FRAMES) is None
