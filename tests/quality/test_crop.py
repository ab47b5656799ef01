from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from occfusion.perceptual import random_crop_box


@settings(max_examples=80, deadline=None)
@given(
    height=st.integers(1, 90), width=st.integers(1, 90), size=st.integers(1, 100), seed=st.integers(0, 10**6),
    share=st.sampled_from([0.0, 0.002, 0.3, 1.0]),
)  # fmt: skip
def test_window_lies_in_the_picture_and_on_the_person(height, width, size, seed, share):
    mask = torch.rand(height, width, generator=torch.Generator().manual_seed(seed)) < share
    x, y, w, h = random_crop_box(mask, size, torch.Generator().manual_seed(seed))
    assert (w, h) == (min(size, width), min(size, height))
    assert 0 <= x <= width - w and 0 <= y <= height - h
    assert not mask.any() or mask[y : y + h, x : x + w].any()
    assert random_crop_box(mask, size, torch.Generator().manual_seed(seed)) == (x, y, w, h)


def test_every_pixel_of_the_person_gets_its_turn_and_background_beyond_the_box_never():
    mask = torch.zeros(100, 80, dtype=torch.bool)
    mask[20:90, 10:50] = True
    counts = torch.zeros(100, 80)
    generator = torch.Generator().manual_seed(0)
    for _ in range(400):
        x, y, w, h = random_crop_box(mask, 24, generator)
        counts[y : y + h, x : x + w] += 1
    assert (counts[mask] > 10).all()
    assert (counts[~mask] == 0).all()
