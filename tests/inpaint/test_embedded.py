"""The embedded inpainter: planes, signal, batches, and what a frame becomes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.testing import assert_close

from made_up_person import made_up_observation
from occfusion.errors import NumericsError
from occfusion.inpaint.appearance_net import (
    ALPHA,
    COARSE,
    COMPLETE,
    DEPTH,
    KNEE,
    OBSERVED,
    PLANES,
    SEEN,
    SIZE,
    VISIBLE,
    AppearanceNet,
    from_signal,
    take_planes,
    to_signal,
)
from occfusion.inpaint.partial import (
    KNOWN,
    SOLID,
    CoarsePictures,
    Inpainter,
    Partial,
    Picture,
    checked_picture,
)
from occfusion.prior_training.appearance_batches import (
    REGION_WEIGHT,
    WINDOW,
    Example,
    as_floats,
    make_batch,
    region_of,
    unseen_of,
    whole_batch,
)


def made_up_partial(size: int = 96) -> Partial:
    """The half-hidden red person, whose coarse avatar is blue."""
    observation = made_up_observation(size)
    complete = observation.visible.copy()
    complete[int(0.2 * size) : int(0.8 * size), int(0.37 * size) : size // 2] = True
    alpha = complete.astype(np.float32)
    coarse = alpha[..., None] * np.array([0.1, 0.2, 0.7], np.float32)
    return Partial(observation, complete, coarse, alpha, lambda: coarse, 0.5 * alpha)


class Constant(Inpainter):
    name = "constant"

    def __init__(self, picture: NDArray[np.float32]) -> None:
        self.picture = picture

    def describe(self) -> dict[str, Any]:
        return {"inpainter": self.name}

    def inpaint(self, partial: Partial) -> Picture:
        return self.picture


def test_only_the_region_is_painted() -> None:
    partial = made_up_partial()
    green = np.zeros_like(partial.coarse)
    green[..., 1] = 2.0
    picture = checked_picture(Constant(green), partial)
    visible, region = partial.observation.visible, partial.region
    assert region.any() and not (region & visible).any()
    assert_close(picture[visible], partial.observation.rgb[visible])
    assert (picture[region] == (0.0, 1.0, 0.0)).all()  # clipped
    assert (picture[~visible & ~region] == 0.0).all()


def test_the_region_needs_a_solid_rendering() -> None:
    partial = made_up_partial()
    faint = Partial(
        **{**vars(partial), "alpha": np.where(partial.alpha > 0, SOLID - 0.01, 0).astype(np.float32)}
    )
    assert partial.region.any() and not faint.region.any()


def test_wrong_pictures_are_refused_with_the_frame_named() -> None:
    partial = made_up_partial()
    broken = partial.coarse.copy()
    broken[3, 4, 0] = np.nan
    with pytest.raises(NumericsError, match=r"constant, frame frame 000003: 1 values are not finite"):
        checked_picture(Constant(broken), partial)
    with pytest.raises(NumericsError, match="a picture of shape"):
        checked_picture(Constant(broken[:-1]), partial)


def test_planes_show_what_they_are_named_after() -> None:
    partial = made_up_partial()
    _, planes = take_planes(partial)
    assert planes.shape == (len(PLANES), SIZE, SIZE) and np.isfinite(planes).all()
    seen, person = planes[VISIBLE] > 0.99, planes[COMPLETE] > 0.99
    assert 0 < seen.sum() < person.sum()
    assert_close(planes[OBSERVED][:, seen].T, np.tile(np.float32([0.9, 0.2, 0.1]), (int(seen.sum()), 1)))
    assert (planes[OBSERVED][:, planes[VISIBLE] == 0] == 0).all()
    assert_close(planes[COARSE][:, person].T, np.tile(np.float32([0.1, 0.2, 0.7]), (int(person.sum()), 1)))
    assert np.abs(planes[DEPTH]).max() <= 1.0
    assert (np.delete(planes, DEPTH, axis=0) >= 0.0).all() and (planes <= 1.0 + 1e-6).all()


def test_the_signal_holds_the_difference() -> None:
    planes = torch.rand(2, len(PLANES), 8, 8, dtype=torch.float64)
    truth = torch.rand(2, 3, 8, 8, dtype=torch.float64)
    truth[0, 0, 0] = planes[0, 0, 0]
    assert_close(planes[:, COARSE] + from_signal(to_signal(truth, planes)), truth)
    black, white = torch.zeros_like(planes), torch.ones_like(planes)
    assert_close(to_signal(white[:, :3], black), white[:, :3])
    assert_close(to_signal(black[:, :3], white), -white[:, :3])


def test_small_differences_are_not_small_signals() -> None:
    planes = torch.zeros(1, len(PLANES), 1, 4)
    truth = torch.tensor([0.0, KNEE, 2.0 * KNEE, 0.5]).expand(1, 3, 1, 4)
    signal = to_signal(truth, planes)[0, 0, 0]
    assert signal[0] == 0.0 and signal[1] > 0.15 and (signal.diff() > 0).all()
    # half the range has most of the signal: what a wrong outline leaves does not outweigh all else
    assert signal[3] > 0.8


def test_the_network_listens_to_its_planes() -> None:
    torch.manual_seed(0)
    net = AppearanceNet((8, 16), 1)
    for layer in (net.net.leave, net.net.detail[-1]):
        torch.nn.init.normal_(layer.weight, std=0.1)
    noisy, t = torch.randn(1, 3, 16, 16), torch.ones(1)
    planes = torch.rand(1, len(PLANES), 16, 16)
    answer = net(noisy, t, planes)
    assert answer.shape == noisy.shape
    for k in range(len(PLANES)):
        other = planes.clone()
        other[:, k] = 0.0
        assert not torch.allclose(net(noisy, t, other), answer), PLANES[k]


def make_example(seed: int = 0) -> Example:
    rng = np.random.default_rng(seed)
    planes = rng.integers(0, 256, (len(PLANES), SIZE, SIZE)).astype(np.uint8)
    planes[VISIBLE] = np.where(np.arange(SIZE) < SIZE // 2, 255, 0)
    mask = np.zeros((SIZE, SIZE), np.uint8)
    mask[60:200, 90:170] = 255
    return Example(planes, rng.integers(0, 256, (3, SIZE, SIZE)).astype(np.uint8), mask)


def test_batches_are_windows_about_hidden_pixels_and_repeat() -> None:
    examples = [make_example(k) for k in range(6)]
    batch = make_batch(examples, np.random.default_rng(1))
    assert batch.clean.shape == (6, 3, WINDOW, WINDOW) and batch.clean.abs().max() <= 1.0
    assert batch.conditions.shape == (6, len(PLANES), WINDOW, WINDOW)
    assert (batch.weight.amax(dim=(1, 2, 3)) >= REGION_WEIGHT).all(), "each window holds pixels of R"
    again = make_batch(examples, np.random.default_rng(1))
    assert torch.equal(batch.clean, again.clean) and torch.equal(batch.conditions, again.conditions)
    other = make_batch(examples, np.random.default_rng(2))
    assert not torch.equal(batch.conditions, other.conditions)


def test_what_no_frame_shows_weighs_most() -> None:
    example = make_example()
    partial_seen = np.where(np.arange(SIZE) < SIZE // 4, 250, 3).astype(np.uint8)
    example.planes[ALPHA] = np.where(np.arange(SIZE)[:, None] < SIZE // 2, 255, 0)
    example.planes[SEEN] = partial_seen
    batch = whole_batch([example])
    weight, planes = batch.weight[0, 0], batch.conditions[0]
    hidden, solid = planes[VISIBLE] <= 0.5, planes[ALPHA] > SOLID
    unseen = hidden & solid & (planes[SEEN] < KNOWN * planes[ALPHA])
    assert torch.equal(region_of(batch.conditions)[0], hidden & solid)
    assert torch.equal(unseen_of(batch.conditions)[0], unseen) and unseen.any()
    assert (weight[unseen] == 1.0).all() and (weight[hidden & solid & ~unseen] == REGION_WEIGHT).all()
    assert (weight[~hidden] < REGION_WEIGHT).all()
    rng = np.random.default_rng(3)
    windows = [unseen_of(make_batch([example], rng).conditions).any() for _ in range(20)]
    assert sum(map(bool, windows)) > 10


def test_colours_of_a_batch_change_together() -> None:
    """Where truth and rendering agree, they agree in whatever colours a batch shows them."""
    example = make_example()
    same = Example(example.planes, example.planes[COARSE].copy(), example.mask)
    batch = make_batch([same] * 8, np.random.default_rng(0))
    assert batch.clean.abs().max() < 1e-6


def test_examples_come_back_as_they_were() -> None:
    planes, truth, mask = as_floats(make_example())
    assert planes[DEPTH].min() < -0.9 and planes[DEPTH].max() > 0.9
    whole = whole_batch([make_example()])
    assert_close(whole.conditions[0].numpy(), planes)
    assert_close(from_signal(whole.clean[0]).numpy(), truth - planes[COARSE], atol=1e-5, rtol=1e-4)
    assert mask.max() == 1.0


def test_the_coarse_source_changes_nothing() -> None:
    partial = made_up_partial()
    picture = checked_picture(CoarsePictures(), partial)
    assert_close(picture[partial.region], partial.coarse[partial.region])
