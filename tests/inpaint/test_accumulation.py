"""Colours gathered from visible pixels against pictures of one Gaussian at a time."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch.testing import assert_close

from occfusion.human import Avatar
from occfusion.human.rendering import Renderer
from occfusion.inpaint.accumulation import (
    BEHIND,
    BLUR,
    ENOUGH,
    PASSES,
    SOME,
    Accumulated,
    accumulate,
    learning_shares,
    paint_observed,
    paint_unseen,
    sharpened,
)
from occfusion.splat import rasterize
from occfusion.types import Frame

RENDERER = Renderer("torch")

SIZE = 48
MakeFrame = Callable[..., Frame]


def left_half() -> torch.Tensor:
    hidden = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    hidden[:, : SIZE // 2] = True
    return hidden


def pictures_one_by_one(avatar: Avatar, frame: Frame) -> tuple[torch.Tensor, torch.Tensor]:
    """Blending weights in visible pixels, `[N, H, W]`, and depths along the camera's axis, `[N]`."""
    with torch.no_grad():
        cloud = avatar(frame.pose, frame.camera.centre)
        shares = []
        for k in range(len(cloud.means)):
            colors = torch.zeros_like(cloud.colors)
            colors[k] = 1.0
            shares.append(
                rasterize(
                    cloud.means, None, None, cloud.opacities, colors, frame.camera.viewmat, frame.camera.K, SIZE, SIZE,
                    covariances=cloud.covariances, backend="torch",
                ).rgb[..., 0] * frame.visible_mask
            )  # fmt: skip
    places = torch.cat([cloud.means, torch.ones(len(cloud.means), 1)], dim=1)
    return torch.stack(shares), (places @ frame.camera.viewmat.to(places).T)[:, 2]


def in_front(avatar: Avatar, frame: Frame) -> torch.Tensor:
    """Pixel by pixel: how far behind their mean depth a Gaussian lies in the mean of its own pixels; 1 in front."""
    shares, depths = pictures_one_by_one(avatar, frame)
    mean_depth = (shares * depths[:, None, None]).sum(dim=0) / shares.sum(dim=0).clamp(min=1e-6)
    own = (shares * mean_depth).sum(dim=(1, 2)) / shares.sum(dim=(1, 2)).clamp(min=1e-9)
    return 1.0 / (1.0 + ((depths - own - BEHIND) / BLUR).exp())


def one_by_one(avatar: Avatar, frame: Frame, *, through: bool = True) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights and weighted colours from a picture of each Gaussian alone in white among black ones."""
    shares, _ = pictures_one_by_one(avatar, frame)
    counts = torch.ones(len(shares)) if through else in_front(avatar, frame)
    return counts * shares.sum(dim=(1, 2)), counts[:, None] * (shares[..., None] * frame.rgb).sum(dim=(1, 2))


def test_what_shines_through_need_not_count(avatar: Avatar, make_frame: MakeFrame) -> None:
    frame = make_frame(0)
    _, depths = pictures_one_by_one(avatar, frame)
    whole, found = (accumulate(avatar, [frame], RENDERER, through=through) for through in (True, False))
    assert (found.weights <= whole.weights + 1e-4).all()
    behind = whole.weights > 2.0 * found.weights
    assert behind.any() and not behind.all(), "some of the scene's Gaussians shine through others"
    assert depths[behind].median() > depths[~behind].median()


def test_the_far_side_of_a_body_is_behind_and_alone_it_is_in_front(
    avatar: Avatar, make_frame: MakeFrame
) -> None:
    frame = make_frame(0)
    _, depths = pictures_one_by_one(avatar, frame)
    far = depths > depths.median() + 0.1

    def shares() -> tuple[torch.Tensor, torch.Tensor]:
        whole, front = (
            accumulate(avatar, [frame], RENDERER, 0.6, through=through).weights for through in (True, False)
        )
        return whole > 0.5, front / whole

    seen_of_both, both = shares()
    with torch.no_grad():
        avatar.gaussians.means[~far] += 100.0  # out of the picture
    seen_alone, alone = shares()
    count = far & seen_of_both & seen_alone
    assert count.any()
    assert both[count].median() < 0.1
    assert alone[count].median() > 0.9


def test_learning_shares_are_of_what_vertices_show(avatar: Avatar) -> None:
    """The Gaussians of a vertex count together."""
    vertices = len(avatar.da_vertices)
    rows = torch.arange(avatar.gaussians.num_gaussians) % 3
    avatar.gaussians.set_vertex_index(rows)
    weights = torch.where(rows == 0, 0.0, torch.where(rows == 1, ENOUGH / (rows == 1).sum(), 1e6))
    shares = learning_shares(avatar, Accumulated(torch.zeros(len(rows), 3), weights))
    assert shares.shape == (vertices,)
    assert_close(shares[:3], torch.tensor([0.0, 0.5, 1.0]), rtol=0, atol=1e-5)
    assert (shares[3:] == 0).all()


@pytest.mark.parametrize("through", [True, False])
def test_weights_and_colours_are_those_of_the_visible_pixels(
    avatar: Avatar, make_frame: MakeFrame, through: bool
) -> None:
    frames = [make_frame(0), make_frame(1, left_half())]
    found = accumulate(avatar, frames, RENDERER, through=through)
    parts = [one_by_one(avatar, frame, through=through) for frame in frames]
    weights = parts[0][0] + parts[1][0]
    assert_close(found.weights, weights, rtol=1e-4, atol=1e-4)
    well_seen = weights > 50 * ENOUGH  # the neighbours' share is below 2 %
    if not bool(well_seen.any()):
        well_seen = weights > weights.median()
    colors = (parts[0][1] + parts[1][1])[well_seen] / weights[well_seen, None]
    share = (weights / (weights + ENOUGH))[well_seen, None]
    assert ((found.colors[well_seen] - colors).abs() <= (1.0 - share) + 1e-4).all()


def test_what_is_hidden_counts_nothing(avatar: Avatar, make_frame: MakeFrame) -> None:
    everything = torch.ones(SIZE, SIZE, dtype=torch.bool)
    alone = accumulate(avatar, [make_frame(0, left_half())], RENDERER)
    with_hidden = accumulate(avatar, [make_frame(0, left_half()), make_frame(1, everything)], RENDERER)
    assert_close(with_hidden.weights, alone.weights)
    assert_close(with_hidden.colors, alone.colors)
    nothing = accumulate(avatar, [make_frame(0, everything)], RENDERER)
    assert (nothing.weights == 0).all() and (nothing.colors == 0.5).all()


def test_unseen_gaussians_take_the_colours_of_neighbours(avatar: Avatar, make_frame: MakeFrame) -> None:
    frame = make_frame(0)
    red = Frame(**{**vars(frame), "rgb": torch.tensor([0.8, 0.1, 0.2]).expand(SIZE, SIZE, 3).contiguous()})
    found = accumulate(avatar, [red], RENDERER)
    assert (found.weights < ENOUGH).any(), "the scene has hidden Gaussians"
    assert_close(found.colors, torch.tensor([0.8, 0.1, 0.2]).expand_as(found.colors), rtol=0, atol=2e-3)


def test_colours_are_those_under_even_light(avatar: Avatar, make_frame: MakeFrame) -> None:
    """What was observed of a Gaussian is divided by how bright the lamp makes it in that frame."""
    lit = Avatar(
        avatar.body, refine_pose=False, learn_skinning=False, sh_degree=0, gaussians=avatar.gaussians,
        key_light=torch.tensor([0.5, 0.3, -0.8]),
    )  # fmt: skip
    frames = [make_frame(0), make_frame(1, left_half())]
    weights, sums = 0.0, 0.0
    for frame in frames:
        weight, observed = one_by_one(lit, frame)
        with torch.no_grad():
            bright = (
                lit(frame.pose, frame.camera.centre).colors / avatar(frame.pose, frame.camera.centre).colors
            )
        weights, sums = weights + weight, sums + observed / bright
    found, even = accumulate(lit, frames, RENDERER), accumulate(avatar, frames, RENDERER)
    known = (weights > ENOUGH) & sums.isfinite().all(
        dim=1
    )  # colours below zero are cut off, and tell no brightness
    share = (weights / (weights + ENOUGH))[known, None]
    own, away = (sums / weights[:, None])[known], (found.colors - even.colors)[known].abs()
    assert away.max() > 0.05, "the lamp makes a difference here"
    assert known.any()
    assert (
        (found.colors[known] - own).abs() <= 0.5 * (1.0 - share) + 1e-4
    ).all()  # the rest is the neighbours' share


def test_the_avatar_is_not_changed_and_grows_no_gradient(avatar: Avatar, make_frame: MakeFrame) -> None:
    before = {name: value.clone() for name, value in avatar.state_dict().items() if torch.is_tensor(value)}
    accumulate(avatar, [make_frame(0)], RENDERER)
    for name, value in before.items():
        assert torch.equal(avatar.state_dict()[name], value), name
    assert all(parameter.grad is None for parameter in avatar.parameters())


def test_seen_grows_with_the_weight() -> None:
    seen = Accumulated(torch.zeros(3, 3), torch.tensor([0.0, ENOUGH, 1e6])).seen
    assert_close(seen, torch.tensor([0.0, 0.5, 1.0]), rtol=0, atol=1e-5)


def test_what_nobody_saw_is_painted_and_what_was_seen_stays(avatar: Avatar, make_frame: MakeFrame) -> None:
    """Weights of none, infinitely many and `ENOUGH` pixels: the nearby colour, the own one, and their mean."""
    avatar.gaussians.allocate_bands(1)
    avatar.active_sh_degree = 1
    with torch.no_grad():
        avatar.gaussians.sh_rest.normal_(generator=torch.Generator().manual_seed(4))
    pose, count = make_frame(0).pose, avatar.gaussians.num_gaussians
    centres = [torch.tensor([0.0, 0.0, -9.0]), torch.tensor([9.0, 1.0, 2.0])]
    with torch.no_grad():
        own = [avatar(pose, centre).colors for centre in centres]
    nearby = torch.rand(count, 3, generator=torch.Generator().manual_seed(5)) * 0.2 + 0.4
    weights = torch.tensor([0.0, 1e12, ENOUGH]).repeat(count)[:count]
    paint_unseen(avatar, Accumulated(nearby, weights))
    for centre, before in zip(centres, own, strict=True):
        with torch.no_grad():
            after = avatar(pose, centre).colors
        assert_close(after[0::3], nearby[0::3])
        assert_close(after[1::3], before[1::3])
        inside = (before[2::3] > 0) & (after[2::3] > 0)  # colours below zero are cut off
        assert inside.any()
        assert_close(after[2::3][inside], (0.5 * (before + nearby))[2::3][inside])
    assert not torch.equal(own[0], own[1]), "colours depend on the direction"


def test_a_given_opacity_is_that_of_all_gaussians(avatar: Avatar, make_frame: MakeFrame) -> None:
    frame = make_frame(0)
    found = accumulate(avatar, [frame], RENDERER, opacity=0.95)
    with torch.no_grad():
        avatar.gaussians.opacity_logits.fill_(torch.logit(torch.tensor(0.95)))
    known, _ = one_by_one(avatar, frame)
    assert_close(found.weights, known, rtol=1e-4, atol=1e-4)


def test_observed_colours_are_given_to_all_and_seen_from_all_sides(
    avatar: Avatar, make_frame: MakeFrame
) -> None:
    frame = make_frame(0, left_half())
    paint_observed(avatar, accumulated := accumulate(avatar, [frame], RENDERER, opacity=0.95))
    for centre in (frame.camera.centre, -frame.camera.centre):
        assert_close(avatar(frame.pose, centre).colors, accumulated.colors, rtol=0, atol=1e-5)


def test_few_pixels_for_many_gaussians_are_better_than_grey(
    avatar: Avatar, make_frame: MakeFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("occfusion.inpaint.accumulation.ENOUGH", 1e6)
    frame = make_frame(0)
    red = Frame(**{**vars(frame), "rgb": torch.tensor([0.8, 0.1, 0.2]).expand(SIZE, SIZE, 3).contiguous()})
    found = accumulate(avatar, [red], RENDERER)
    assert_close(found.colors, torch.tensor([0.8, 0.1, 0.2]).expand_as(found.colors), rtol=0, atol=2e-3)
    assert (found.seen > 0.5).sum() >= (found.weights > SOME).sum() // 2 - 1


LAMP = torch.tensor([0.5, 0.3, -0.8])


@pytest.mark.parametrize("lamp", [None, LAMP])
def test_detail_is_added_as_a_dense_matrix_has_it(
    avatar: Avatar, make_frame: MakeFrame, lamp: torch.Tensor | None
) -> None:
    """The picture as a matrix of each Gaussian's share in each visible pixel, inverted step by step in float64."""
    frames = [make_frame(0), make_frame(1, left_half())]
    avatar.relight(lamp)
    before = accumulate(avatar, frames, RENDERER)
    found = sharpened(avatar, lambda: frames, RENDERER, before)
    shares = [pictures_one_by_one(avatar, frame)[0].flatten(1).double() for frame in frames]
    counts = sum(share.sum(dim=1) for share in shares).clamp(min=SOME)
    weights, colors = before.weights.double(), before.colors.double()
    trusted = before.seen.double() * weights / (weights + weights[weights > SOME].median())
    shade = avatar.brightness(avatar.deform(frames[0].pose)) if lamp is not None else torch.ones(len(weights))
    for _ in range(PASSES):
        lacking = torch.zeros_like(colors)
        for share, frame in zip(shares, frames, strict=True):
            drawn = share.T @ (colors * shade[:, None].double())
            visible = frame.visible_mask.flatten()[:, None]
            lacking += (
                share @ (visible * (frame.rgb.flatten(0, 1).double() - drawn)) / shade[:, None].double()
            )
        colors = (colors + trusted[:, None] * lacking / counts[:, None]).clamp(0.0, 1.0)
    assert_close(found.colors.double(), colors, rtol=0, atol=2e-4)
    assert torch.equal(found.weights, before.weights)
    assert (found.colors - before.colors).abs().max() > 0.02, "there was detail to add"


def test_pictures_of_sharpened_colours_are_nearer_to_the_frames(
    avatar: Avatar, make_frame: MakeFrame
) -> None:
    frame = make_frame(0)
    before = accumulate(avatar, [frame], RENDERER)
    errors = []
    for found in (before, sharpened(avatar, lambda: [frame], RENDERER, before)):
        paint_observed(avatar, found)
        drawn = RENDERER.frame(avatar, frame).rgb
        errors.append(float((drawn - frame.rgb)[frame.visible_mask].square().mean()))
    assert errors[1] < 0.8 * errors[0]


def test_what_no_frame_shows_is_not_sharpened(avatar: Avatar, make_frame: MakeFrame) -> None:
    everything = torch.ones(SIZE, SIZE, dtype=torch.bool)
    hidden = [make_frame(0, everything)]
    nothing = accumulate(avatar, hidden, RENDERER)
    assert sharpened(avatar, lambda: hidden, RENDERER, nothing) is nothing
    half = [make_frame(0, left_half())]
    with torch.no_grad():
        avatar.gaussians.means[:5] += 100.0  # out of the picture
    before = accumulate(avatar, half, RENDERER)
    after = sharpened(avatar, lambda: half, RENDERER, before)
    unseen = before.weights == 0
    assert unseen.any() and torch.equal(after.colors[unseen], before.colors[unseen])
    assert after.colors.isfinite().all() and all(p.grad is None for p in avatar.parameters())
