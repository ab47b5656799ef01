"""Completion of colours: what the network is told, what it may change, and people it has not learned from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from occfusion.errors import DataError
from occfusion.geometry.normals import vertex_normals
from occfusion.human import Avatar, Gaussians
from occfusion.human.body import embedded_body
from occfusion.human.unfolded import UnfoldedBody
from occfusion.inpaint.accumulation import Accumulated
from occfusion.inpaint.completion import ColorCompleter, CompletionSettings, write_completion
from occfusion.inpaint.completion_net import (
    BODY,
    FILLED,
    LEAST_SPREAD,
    LEVEL,
    PLANES,
    SEEN,
    SIDES,
    SIZE,
    CompletionNet,
    brightness_gain,
    check_completion_net,
    completion_loss,
    completion_planes,
    load_completion_net,
)
from occfusion.prior_training.completion_examples import make_example, watched
from occfusion.prior_training.completion_people import mixed_subject, vertex_colours
from occfusion.prior_training.completion_task import CompletionTask
from occfusion.settings.stages import PriorTrainingSettings
from occfusion.synth.subject import make_subject


@pytest.fixture(scope="module")
def completer() -> ColorCompleter:
    return ColorCompleter(embedded_body(), CompletionSettings())


def floats(example):
    names = ("filled", "seen", "truth")
    return tuple(torch.from_numpy(getattr(example, name).astype(np.float32)) / 255.0 for name in names)


def psnr(found: torch.Tensor, truth: torch.Tensor) -> float:
    return float(-10.0 * (found - truth).square().mean().log10())


class Told(torch.nn.Module):
    """Stands for a network that answers what it is given."""

    def __init__(self, colors: torch.Tensor, spread: torch.Tensor) -> None:
        super().__init__()
        self.colors, self.spread = torch.nn.Parameter(colors), torch.nn.Parameter(spread)

    def forward(self, _planes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.colors, self.spread


def test_an_untrained_network_keeps_mostly_what_is_filled():
    planes = torch.rand(1, PLANES, 32, 32)
    colors, _ = CompletionNet((16, 24), 1)(planes)
    shift = (colors - planes[:, FILLED].unflatten(1, (SIDES, 3))).abs().max()
    assert float(shift.detach()) < 0.35  # copies of other places have an eighth of the weight each


def test_copies_are_of_the_other_side_and_of_the_mirrored_place():
    """Without anything of its own the network mixes three colours, its own filled one first."""
    net, planes = CompletionNet((16, 24), 1).double(), torch.rand(1, PLANES, 32, 32).double()
    for last in (net.net.leave, net.net.detail[-1]):
        torch.nn.init.zeros_(last.bias)
    filled = planes[:, FILLED]
    mixed = np.exp(2.0) * filled + filled.roll(3, dims=1) + filled.flip(-1)
    torch.testing.assert_close(net(planes)[0].flatten(1, 2), mixed / (np.exp(2.0) + 2.0))


def test_loss_against_a_loop():
    torch.manual_seed(0)
    colors, spread = torch.rand(2, SIDES, 3, 4, 4), torch.randn(2, SIDES, 4, 4) - 3.0
    truth, weight = torch.rand(2, SIDES * 3, 4, 4), torch.rand(2, SIDES, 4, 4)
    total = 0.0
    for b, side, row, column in np.ndindex(2, SIDES, 4, 4):
        difference = colors[b, side, :, row, column] - truth[b, 3 * side : 3 * side + 3, row, column]
        d = float(difference.norm())
        s = max(float(spread[b, side, row, column].exp()), LEAST_SPREAD)
        total += float(weight[b, side, row, column]) * (d + 0.01 * (2.0 * d / s + 3.0 * np.log(s)))
    found = completion_loss(Told(colors, spread), truth, torch.zeros(0), weight)
    assert float(found) == pytest.approx(total / float(weight.sum()), rel=1e-4)


def test_the_loss_asks_for_the_median_and_for_the_standard_deviation():
    """Of colours that are one of two, the more frequent; of a density as assumed, its standard deviation."""
    generator = torch.Generator().manual_seed(1)
    direction = torch.randn(4000, 3, generator=generator)
    radii = torch.distributions.Gamma(3.0, 1.0 / 0.05).sample(
        (4000,)
    )  # d^2 exp(-d / b), b = 0.05, so s = 0.1
    noise = (direction / direction.norm(dim=1, keepdim=True) * radii[:, None]).T.reshape(1, 1, 3, 40, 100)
    told = Told(torch.full((1, 1, 3, 1, 1), 0.7), torch.zeros(1, 1, 1, 1) - 1.0)
    adam = torch.optim.Adam(told.parameters(), lr=0.02)
    truth = (0.5 + noise).expand(1, SIDES, 3, 40, 100).flatten(1, 2)
    for _ in range(400):
        adam.zero_grad()
        loss = completion_loss(
            lambda _: (told.colors.expand(1, SIDES, 3, 40, 100), told.spread.expand(1, SIDES, 40, 100)),
            truth, torch.zeros(0), torch.ones(1, SIDES, 40, 100),
        )  # fmt: skip
        loss.backward()
        adam.step()
    assert float((told.colors - 0.5).abs().max()) < 0.01
    assert float(told.spread.exp()) == pytest.approx(0.1, rel=0.05)
    assert float(noise.std()) == pytest.approx(0.1, rel=0.05)
    two = torch.where(torch.rand(40, 100, generator=generator) < 0.7, 0.2, 0.8).expand(1, SIDES * 3, 40, 100)
    flat = [
        float(completion_loss(lambda _, c=c: (torch.full((1, SIDES, 3, 40, 100), c), torch.zeros(1, SIDES, 40, 100)),
                              two, torch.zeros(0), torch.ones(1, SIDES, 40, 100)))
        for c in (0.2, 0.38, 0.8)
    ]  # fmt: skip
    assert flat[0] == min(flat), "the more frequent one, not the mean 0.38"


def test_the_spread_does_not_move_the_colours():
    colors, spread = torch.rand(1, SIDES, 3, 2, 2), torch.zeros(1, SIDES, 2, 2)
    truth, weight = torch.rand(1, SIDES * 3, 2, 2), torch.ones(1, SIDES, 2, 2)
    gradients = []
    for value in (spread, spread - 4.0):
        told = Told(colors, value)
        completion_loss(told, truth, torch.zeros(0), weight).backward()
        gradients.append(told.colors.grad)
        assert torch.isfinite(told.spread.grad).all()
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("spread", [-50.0, 50.0])
def test_the_loss_stays_finite_with_a_spread_of_any_size(spread):
    told = Told(torch.full((1, SIDES, 3, 1, 1), 0.5), torch.full((1, SIDES, 1, 1), spread))
    exact = torch.full((1, SIDES * 3, 1, 1), 0.5)
    loss = completion_loss(told, exact, torch.zeros(0), torch.ones(1, SIDES, 1, 1))
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(told.colors.grad).all()


def test_planes_are_where_they_are_said_to_be():
    body = UnfoldedBody(embedded_body(), 32)
    count = embedded_body().num_vertices
    filled, seen = torch.rand(count, 3), torch.rand(count)
    planes = completion_planes(body, filled, seen)
    assert planes.shape == (PLANES, 32, 32)
    torch.testing.assert_close(planes[FILLED], body.unfold(filled).flatten(0, 1))
    torch.testing.assert_close(planes[SEEN], body.unfold(seen[:, None])[:, 0])
    assert torch.equal(planes[BODY] > 0, body.mask)


def test_what_is_known_stays(completer):
    filled = torch.rand(embedded_body().num_vertices, 3)
    found = completer.complete(filled, torch.ones(len(filled)))
    torch.testing.assert_close(found.colors, filled)
    assert float(found.spread.abs().max()) == 0.0


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_nothing_seen_and_flat_colours_stay_finite_and_in_range(completer, value):
    filled = torch.full((embedded_body().num_vertices, 3), value)
    found = completer.complete(filled, torch.zeros(len(filled)))
    assert torch.isfinite(found.colors).all()
    assert float(found.colors.min()) >= 0.0 and float(found.colors.max()) <= 1.0


@pytest.fixture(scope="module")
def strangers():
    """People whom the network has not learned from: colours nearby, how well each is seen, the truth."""
    return [floats(make_example(number, 11, validation=True)) for number in range(6)]


@pytest.mark.parametrize("brightness", [1.0, 0.7, 0.5, 0.3, 0.02])
def test_people_it_has_not_learned_from_are_completed_better_than_by_what_is_nearby(
    completer, strangers, brightness
):
    gains = []
    for bright_filled, seen, bright_truth in strangers:
        filled, truth = brightness * bright_filled, brightness * bright_truth
        found, unseen = completer.complete(filled, seen), seen < 0.2
        gains.append(psnr(found.colors[unseen], truth[unseen]) - psnr(filled[unseen], truth[unseen]))
    assert np.mean(gains) > 0.5 and min(gains) > -0.5, gains


@pytest.mark.parametrize("brightness", [0.9, 0.3, 0.03])
def test_the_answer_is_in_proportion_to_the_brightness(completer, strangers, brightness):
    filled, seen, _ = strangers[0]
    bright, dark = completer.complete(filled, seen), completer.complete(brightness * filled, seen)
    is_inside = (bright.colors > 0.0) & (bright.colors < 1.0)  # of the range of colours
    assert is_inside.float().mean() > 0.9
    torch.testing.assert_close(
        dark.colors[is_inside], brightness * bright.colors[is_inside], atol=1e-6, rtol=1e-3
    )
    torch.testing.assert_close(dark.spread, brightness * bright.spread, atol=1e-6, rtol=1e-3)


def test_where_it_is_unsure_it_is_wrong_more_often(completer):
    filled, seen, truth = floats(make_example(3, 11, validation=True))
    found, unseen = completer.complete(filled, seen), seen < 0.2
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
    accumulated = Accumulated(filled, 1000.0 * (seen > 0.5))
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


@pytest.mark.parametrize("facing", [0.0, 180.0])
def test_what_a_camera_sees_of_a_person_is_that_side_in_its_colours(facing):
    """Vertices that face the camera are known, few on the other side, of which turns and arms show a little."""
    subject, body = make_subject(95), embedded_body()
    truth = vertex_colours(subject, None)
    normals = vertex_normals(body.da_vertices().numpy(), body.faces.numpy())
    towards = normals[:, 2] * (1.0 if facing == 0.0 else -1.0)
    for seed in range(3):
        shown = watched(truth, subject.betas, np.random.default_rng(seed), facing)
        known = (shown.seen > 0.5).float()
        front, back = float(known[towards > 0.7].mean()), float(known[towards < -0.7].mean())
        assert front > back + 0.25 and back < 0.45, seed  # a strip may hide much of the front in all frames
        well = (shown.seen > 0.95).numpy() & (towards > 0.7)
        assert np.abs(shown.colors.numpy() - truth)[well].mean() < 0.12


def test_people_of_a_batch_are_equally_bright(tmp_path):
    """However dark a person is, the root mean square of what is seen is `LEVEL` for the network."""
    task = CompletionTask(PriorTrainingSettings(network="completion", batch=2), tmp_path, 0)
    example = make_example(0, 0)
    dark = replace(example, truth=example.truth // 3, filled=example.filled // 3)
    batches = [
        task.make_batch([each], rng) for each in (example, dark) for rng in (None, np.random.default_rng(1))
    ]
    for bright, dim in zip(batches[:2], batches[2:], strict=True):
        for name in ("clean", "conditions"):
            torch.testing.assert_close(getattr(bright, name), getattr(dim, name), atol=0.02, rtol=0.0)
    _, seen, _ = floats(example)
    seen_colors = brightness_gain(floats(dark)[0], seen) * floats(dark)[0]
    level = (seen[:, None] * seen_colors.square()).sum() / (3.0 * seen.sum())
    assert float(level.sqrt()) == pytest.approx(LEVEL, rel=1e-4)


def test_a_batch_mirrors_pictures_and_targets_alike(tmp_path):
    task = CompletionTask(PriorTrainingSettings(network="completion", batch=2), tmp_path, 0)
    examples = [make_example(k, 0) for k in range(2)]
    plain = task.make_batch(examples)
    assert plain.clean.shape == (2, 6, SIZE, SIZE) and plain.weight.shape == (2, SIDES, SIZE, SIZE)
    for seed in range(4):
        batch = task.make_batch(examples, np.random.default_rng(seed))
        known = (batch.conditions[:, SEEN] > 0.95).repeat_interleave(3, dim=1)
        # what is well known is filled with itself, mirrored or not, up to what its observation is off
        assert float((batch.clean - batch.conditions[:, FILLED])[known].abs().mean()) < 0.05


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
