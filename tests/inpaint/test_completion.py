"""Completion of colours: what the network is told, what it may change, and people it has not learned from."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from occfusion.errors import DataError
from occfusion.human import Avatar, Gaussians
from occfusion.human.body import embedded_body
from occfusion.human.unfolded import UnfoldedBody
from occfusion.inpaint.accumulation import Accumulated
from occfusion.inpaint.completion import ColorCompleter, CompletionSettings, write_completion
from occfusion.inpaint.completion_net import (
    BODY,
    FILLED,
    KNEE,
    PLANES,
    SEEN,
    SIZE,
    SPAN,
    CompletionNet,
    check_completion_net,
    completion_planes,
    from_signal,
    load_completion_net,
    to_signal,
)
from occfusion.prior_training.completion_examples import make_example, mixed_subject, vertex_colours
from occfusion.prior_training.completion_task import CompletionTask
from occfusion.settings.stages import PriorTrainingSettings
from occfusion.synth.subject import make_subject


@pytest.fixture(scope="module")
def completer() -> ColorCompleter:
    return ColorCompleter(embedded_body(), CompletionSettings(draws=1, samples=2, steps=2))


def floats(example):
    names = ("filled", "seen", "truth")
    return tuple(torch.from_numpy(getattr(example, name).astype(np.float32)) / 255.0 for name in names)


def psnr(found: torch.Tensor, truth: torch.Tensor) -> float:
    return float(-10.0 * (found - truth).square().mean().log10())


def test_signal_against_a_loop():
    planes = torch.rand(1, PLANES, 2, 2)
    truth = torch.rand(1, 6, 2, 2)
    signal = to_signal(truth, planes)
    for channel, plane in enumerate(FILLED):
        for row in range(2):
            for column in range(2):
                difference = float(truth[0, channel, row, column] - planes[0, plane, row, column])
                assert float(signal[0, channel, row, column]) == pytest.approx(
                    float(np.arcsinh(difference / KNEE)) / SPAN, abs=1e-6
                )
    torch.testing.assert_close(planes[:, FILLED] + from_signal(signal), truth)
    assert float(signal.abs().max()) <= 1.0


def test_an_untrained_network_keeps_mostly_what_is_filled():
    planes = torch.rand(1, PLANES, 32, 32)
    clean = -CompletionNet((16, 24), 1)(torch.randn(1, 6, 32, 32), torch.ones(1), planes)
    shift = from_signal(clean).abs().max()
    assert float(shift.detach()) < 0.35  # copies of other places have an eighth of the weight each


def test_copies_enter_v_as_a_clean_signal_does():
    """Without anything of its own the network says v = - sigma x of a mixture x, whatever the noise."""
    net, planes = CompletionNet((16, 24), 1).double(), torch.rand(1, PLANES, 32, 32).double()
    for last in (net.net.leave, net.net.detail[-1]):
        torch.nn.init.zeros_(last.bias)
    noisy = torch.randn(1, 6, 32, 32).double()
    signals = [
        -net(noisy, torch.tensor([t]).double(), planes) / np.sin(0.5 * np.pi * t) for t in (0.2, 0.6, 1.0)
    ]
    torch.testing.assert_close(signals[0], signals[2])
    torch.testing.assert_close(signals[1], signals[2])
    filled = planes[:, FILLED]
    mixed = np.exp(2.0) * filled + filled.roll(3, dims=1) + filled.flip(-1)
    torch.testing.assert_close(filled + from_signal(signals[2]), mixed / (np.exp(2.0) + 2.0))


def test_planes_are_where_they_are_said_to_be():
    body = UnfoldedBody(embedded_body(), 32)
    count = embedded_body().num_vertices
    filled, seen = torch.rand(count, 3), torch.rand(count)
    planes = completion_planes(body, filled, filled, seen)
    assert planes.shape == (PLANES, 32, 32)
    torch.testing.assert_close(planes[FILLED], body.unfold(filled).flatten(0, 1))
    torch.testing.assert_close(planes[SEEN], body.unfold(seen[:, None])[:, 0])
    assert torch.equal(planes[BODY] > 0, body.mask)


def test_what_is_known_stays(completer):
    filled = torch.rand(embedded_body().num_vertices, 3)
    found = completer.complete(filled, torch.ones(len(filled)))
    torch.testing.assert_close(found.colors, filled)
    assert found.spread is not None and float(found.spread.abs().max()) == 0.0


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_nothing_seen_and_flat_colours_stay_finite_and_in_range(completer, value):
    filled = torch.full((embedded_body().num_vertices, 3), value)
    found = completer.complete(filled, torch.zeros(len(filled)))
    assert torch.isfinite(found.colors).all()
    assert float(found.colors.min()) >= 0.0 and float(found.colors.max()) <= 1.0


def test_people_it_has_not_learned_from_are_completed_better_than_by_what_is_nearby(completer):
    gains = []
    for number in range(6):
        filled, seen, truth = floats(make_example(number, 11, validation=True))
        found, unseen = completer.complete(filled, seen), seen < 0.2
        gains.append(psnr(found.colors[unseen], truth[unseen]) - psnr(filled[unseen], truth[unseen]))
    assert np.mean(gains) > 0.5 and min(gains) > -0.5, gains


def test_where_it_is_unsure_it_is_wrong_more_often():
    completer = ColorCompleter(embedded_body(), CompletionSettings(draws=1, samples=3, steps=4))
    filled, seen, truth = floats(make_example(3, 11, validation=True))
    found, unseen = completer.complete(filled, seen), seen < 0.2
    assert found.spread is not None
    wrong, spread = (found.colors - truth).square().mean(dim=1)[unseen].sqrt(), found.spread[unseen]
    unsure = spread > spread.median()
    assert float(wrong[unsure].mean()) > 1.2 * float(wrong[~unsure].mean())


def test_gaussians_of_an_avatar_take_the_colours_of_their_places(completer):
    body = embedded_body()
    avatar = Avatar(
        body, sh_degree=0, refine_pose=False, learn_skinning=False, gaussians=Gaussians.on_body(body, 0)
    )
    filled, seen, _ = floats(make_example(2, 11, validation=True))
    # weights of which `seen` follows
    accumulated = Accumulated(filled, (weights := 1000.0 * (seen > 0.5)), weights)
    completed, completion = completer.of_avatar(avatar, accumulated)
    known = seen > 0.5
    assert float((completed.colors - filled).abs()[known].mean()) < 0.01
    assert float((completed.colors - completion.colors).abs()[~known].mean()) < 0.03


def test_colours_and_a_picture_are_written(completer, tmp_path):
    filled, seen, _ = floats(make_example(0, 11, validation=True))
    completion = completer.complete(filled, seen)
    write_completion(tmp_path / "completion.npz", tmp_path / "completion.png", completion, completer.body)
    with np.load(tmp_path / "completion.npz", allow_pickle=False) as table:
        assert set(table.files) == {"colors", "filled", "seen", "spread"}
        np.testing.assert_allclose(table["colors"], completion.colors.numpy(), atol=1e-3)
    import cv2

    assert cv2.imread(str(tmp_path / "completion.png")).shape == (4 * SIZE, 2 * SIZE, 3)


def test_examples_are_the_same_every_time_and_people_are_mixed():
    one, again = make_example(5, 0), make_example(5, 0)
    assert all(np.array_equal(getattr(one, name), getattr(again, name)) for name in vars(one))
    rng = np.random.default_rng(0)
    people = [mixed_subject(rng) for _ in range(6)]
    assert len({person.pattern for person in people}) > 1
    skin = vertex_colours(make_subject(1), None)
    assert skin.shape == (embedded_body().num_vertices, 3) and skin.min() >= 0.0 and skin.max() <= 1.0


def test_a_batch_mirrors_pictures_and_targets_alike(tmp_path):
    task = CompletionTask(PriorTrainingSettings(network="completion", batch=2), tmp_path, 0)
    examples = [make_example(k, 0) for k in range(2)]
    plain = task.make_batch(examples)
    assert plain.clean.shape == (2, 6, SIZE, SIZE) and plain.weight.shape == plain.clean.shape
    for seed in range(4):
        batch = task.make_batch(examples, np.random.default_rng(seed))
        known = (batch.conditions[:, SEEN] > 0.95).repeat_interleave(3, dim=1)
        # what is well known is filled with itself, mirrored or not, up to the noise of its observation
        assert float(from_signal(batch.clean)[known].abs().mean()) < 0.05


def test_weights_of_another_prior_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"prior\.completion\.weights"):
        load_completion_net(tmp_path / "none.safetensors")


def test_random_numbers_of_a_run_do_not_depend_on_the_one_before_it() -> None:
    """In a multirun the network was loaded by the first job alone: the second began with other random numbers."""
    drawn = []
    for _ in range(2):
        torch.manual_seed(0)
        check_completion_net()
        drawn.append(torch.rand(4))
    assert torch.equal(*drawn)
    load_completion_net.cache_clear()
    torch.manual_seed(0)
    load_completion_net()
    first = torch.rand(4)
    torch.manual_seed(0)
    load_completion_net()
    assert torch.equal(first, torch.rand(4))
