"""An avatar is drawn with the dilation that it was trained with, wherever it is drawn, and where it is."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from made_up_partial import made_up_partial
from occfusion.human import embedded_body
from occfusion.human.avatar import Avatar
from occfusion.human.rendering import Renderer
from occfusion.inpaint.accumulation import accumulate
from occfusion.inpaint.partial import take_partial
from occfusion.settings.stages import OptimSettings
from occfusion.splat import Limits, rasterize
from occfusion.stages.optim import OptimStage
from occfusion.types import Camera, Cloud, Frame, Pose, Rendering

SIZE = 48


@pytest.fixture
def frame() -> Frame:
    camera = made_up_partial(SIZE).observation.camera
    camera = replace(camera, viewmat=camera.viewmat.float(), K=camera.K.float())
    pose = Pose(torch.zeros(10), torch.zeros(3), torch.zeros(69), torch.tensor([0.0, 0.2, 3.0]))
    seen = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    seen[:, : SIZE // 2] = True
    return Frame(0, 0, "frame", torch.rand(SIZE, SIZE, 3), seen, None, seen, None, camera, pose)


def alpha_of(cloud: Cloud, camera: Camera, dilation: float) -> Tensor:
    return rasterize(
        cloud.means, None, None, cloud.opacities, cloud.colors, camera.viewmat, camera.K, SIZE, SIZE,
        covariances=cloud.covariances, backend="torch", limits=Limits(dilation=dilation),
    ).alpha  # fmt: skip


@pytest.mark.parametrize("dilation", [0.02, 0.3])
def test_every_picture_of_an_avatar_has_its_dilation(frame: Frame, dilation: float) -> None:
    avatar, camera = Avatar(embedded_body(), dilation=dilation).eval(), frame.camera
    with torch.no_grad():
        avatar.gaussians.opacity_logits.fill_(2.0)
        cloud, canonical = avatar(frame.pose, camera.centre), avatar.canonical(camera.centre)
    want, renderer = alpha_of(cloud, camera, dilation), Renderer("torch")
    assert (want - alpha_of(cloud, camera, 0.2)).abs().max() > 0.01
    torch.testing.assert_close(renderer.frame(avatar, frame).alpha, want)
    assert torch.equal(renderer.outline(avatar, frame), want > 0.5)
    torch.testing.assert_close(
        renderer.canonical_alpha(avatar, camera).detach(), alpha_of(canonical, camera, dilation)
    )
    observation = replace(made_up_partial(SIZE).observation, camera=camera)
    accumulated = accumulate(avatar, [frame], renderer)
    # each pixel's weights sum to its occupancy
    torch.testing.assert_close(accumulated.weights.sum(), want[frame.visible_mask].sum(), rtol=1e-4, atol=0.0)
    partial = take_partial(avatar, accumulated, frame, observation, renderer)
    torch.testing.assert_close(torch.from_numpy(partial.alpha), want)
    settings = OptimSettings(lambda_lpips=0.0)
    stage = OptimStage(avatar, settings, perceptual=None, densifier=None, renderer=renderer, seed=0)
    rendering, (x, y, width, height) = stage._render_crop(frame)
    torch.testing.assert_close(rendering.alpha.detach(), want[y : y + height, x : x + width])


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_the_canonical_picture_and_its_gradients_are_those_of_covariances(frame: Frame, backend: str) -> None:
    """Of long, turned Gaussians whose turns are not of length 1; two of the colours' channels count as well."""
    avatar, generator = Avatar(embedded_body(), dilation=0.3), torch.Generator().manual_seed(0)
    gaussians = avatar.gaussians
    with torch.no_grad():
        gaussians.opacity_logits.fill_(1.0)
        gaussians.raw_quats += 0.5 * torch.randn(gaussians.raw_quats.shape, generator=generator)
        gaussians.log_scales += 0.5 * torch.randn(gaussians.log_scales.shape, generator=generator)
    # as the surface prior's views: the pose stands about its own origin
    viewmat = torch.eye(4)
    viewmat[1, 1] = viewmat[2, 2] = -1.0
    viewmat[2, 3] = 3.0
    camera = replace(frame.camera, viewmat=viewmat)
    colors = torch.rand(gaussians.num_gaussians, 3, generator=generator)
    weight = torch.rand(SIZE, SIZE, 4, generator=generator)
    learned = [gaussians.means, gaussians.raw_quats, gaussians.log_scales, gaussians.opacity_logits]

    def of_covariances() -> Rendering:
        cloud = avatar.canonical(camera.centre)
        return Renderer("torch").draw(replace(cloud, colors=colors), camera)

    found = []
    for draw in (lambda: Renderer(backend).canonical(avatar, colors, camera), of_covariances):
        drawn = draw()
        picture = torch.cat([drawn.rgb, drawn.alpha[..., None]], dim=-1)
        found.append([picture.detach(), *torch.autograd.grad((weight * picture).sum(), learned)])
    assert float(found[0][0].max()) > 0.5
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4 * float(b.abs().max()))


def test_between_stages_pictures_are_made_on_the_host_whatever_trains(frame: Frame) -> None:
    """A run on a GPU trains with gsplat; its avatar is back on the host when it is painted, traced and evaluated."""
    avatar = Avatar(embedded_body(), dilation=0.1).eval()
    observation = replace(made_up_partial(SIZE).observation, camera=frame.camera)
    host, trainer = Renderer("auto"), Renderer("auto")
    trainer.backend = "gsplat"  # as it is on a GPU
    accumulated = [accumulate(avatar, [frame], renderer) for renderer in (host, trainer)]
    assert torch.equal(accumulated[0].weights, accumulated[1].weights)
    pictures = [renderer.frame(avatar, frame).rgb for renderer in (host, trainer)]
    assert torch.equal(pictures[0], pictures[1])
    assert torch.equal(host.outline(avatar, frame), trainer.outline(avatar, frame))
    taken = [
        take_partial(avatar, accumulated[0], frame, observation, renderer) for renderer in (host, trainer)
    ]
    assert (taken[0].coarse == taken[1].coarse).all()
