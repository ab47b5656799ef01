"""What a training step consists of: each part alone, forward and backward, at the sizes of a usual run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from occfusion.bench.scenes import SceneSize, make_scene
from occfusion.geometry.resample import take_square
from occfusion.human import Avatar, embedded_body
from occfusion.human.rendering import Renderer
from occfusion.observation.crop import view_canonical
from occfusion.perceptual import load_perceptual
from occfusion.priors.embedded.silhouette_prior import EmbeddedScore
from occfusion.priors.score import Draw, distil
from occfusion.quality import losses
from occfusion.quality.metrics import padded_box
from occfusion.splat import rasterize
from occfusion.types import Box

PERCEPTUAL_CROP = 128
"""Pixels of the window that the perceptual term sees in a training step."""
FIGURE_SIDE = 256
"""Pixels at most of the side of a picture that a perceptual figure is computed of."""
PADDING = 8
"""Pixels around the person in a training step's crop."""


def step_parts(backend: str, gaussians: int, size: int, seed: int) -> dict[str, Callable[[], object]]:
    """Returns the parts of a training step as calls without arguments, by name.

    Args:
        backend: rasteriser backend.
        gaussians: of the rasteriser's scene; the avatar's parts have one for each vertex of the embedded
            body.
        size: side of the picture in pixels; losses see the person's padded box.
        seed: of the scene.
    """
    scene = make_scene(SceneSize(gaussians, size), seed)
    leaves = scene.leaves()
    with torch.no_grad():
        out = rasterize(**scene.arguments(leaves), backend=backend)
    box = padded_box(out.alpha > 0.5, PADDING)
    assert box is not None
    x, y, w, h = box
    picture = out.rgb[y : y + h, x : x + w].clamp(0, 1).contiguous()
    mask = (out.alpha > 0.5)[y : y + h, x : x + w].contiguous()
    target = (
        picture + 0.1 * torch.randn(picture.shape, generator=torch.Generator().manual_seed(seed))
    ).clamp(0, 1)

    def render() -> None:
        given = scene.leaves()
        result = rasterize(**scene.arguments(given), backend=backend, crop=box)
        (result.rgb.sum() + result.alpha.sum()).backward()

    def colours_and_mask() -> None:
        moving = picture.clone().requires_grad_()
        (losses.l1(moving, target, mask) + losses.l2(moving[..., 0], mask.to(moving.dtype))).backward()

    def structure() -> None:
        losses.ssim_loss(picture.clone().requires_grad_(), target, mask).backward()

    return {
        **_avatar_parts(),
        f"rasteriser ({backend}), person's crop": render,
        f"L1 and mask L2, {w} x {h} px": colours_and_mask,
        f"SSIM, {w} x {h} px": structure,
        **_perceptual_parts(picture, target, (x, y, w, h)),
        **_figure_parts(backend, gaussians, min(size, FIGURE_SIDE), seed),
        **_distillation_parts(out.alpha[y : y + h, x : x + w].contiguous(), box, backend),
    }


def _avatar_parts() -> dict[str, Callable[[], object]]:
    body = embedded_body()
    avatar = Avatar(body, sh_degree=3, skinning_every=2)
    avatar.train()
    pose, centre = body.da_pose(), torch.tensor([0.0, 0.0, 3.0])
    rates = dict.fromkeys(("means", "sh0", "sh_rest", "opacity", "scales", "quats", "pose", "skinning"), 1e-6)
    adam = torch.optim.Adam(avatar.parameter_groups(rates), eps=1e-15)

    def deform(turn: int) -> None:
        avatar.prepare(turn)
        cloud = avatar(pose, centre)
        (cloud.means.sum() + cloud.covariances.sum() + cloud.colors.sum() + cloud.opacities.sum()).backward()

    deform(0)
    count = avatar.gaussians.num_gaussians
    return {
        f"avatar with its skinning network, {count} Gaussians": lambda: deform(0),
        f"avatar with kept skinning, {count} Gaussians": lambda: deform(1),
        f"Adam, {sum(p.numel() for p in avatar.parameters())} parameters": lambda: adam.step(),
    }


def _distillation_parts(alpha: Tensor, box: Box, backend: str) -> dict[str, Callable[[], object]]:
    """Returns one distillation of the rendered occupancy, and of the canonical pose with its rendering."""
    body = embedded_body()
    prior = EmbeddedScore()
    view = view_canonical(body, 0, prior.size)
    conditions, mask = prior.encode_conditions(view), torch.ones(prior.size, prior.size)
    camera = replace(view.camera, viewmat=view.camera.viewmat.float(), K=view.camera.K.float())
    avatar, renderer = Avatar(body, sh_degree=0), Renderer(backend)
    draw = Draw(0.9, torch.randn(1, *prior.signal_shape, generator=torch.Generator().manual_seed(0)))

    def push(occupancy: Tensor) -> None:
        distil(
            prior, occupancy, mask, conditions, draw, weighting="sigma2", guidance=1.0, reduction="mean"
        ).backward()

    def posed() -> None:
        moving = alpha.clone().requires_grad_()
        push(take_square(moving, box, box[0], box[1], max(box[2:]), prior.size))

    def canonical() -> None:
        push(renderer.canonical_alpha(avatar, camera))

    return {
        f"distillation, {prior.name} {prior.size} px, the frame's pose": posed,
        f"distillation, {prior.name} {prior.size} px, the canonical pose": canonical,
        f"the prior's conditions, {prior.size} px, once a frame": lambda: prior.encode_conditions(view),
    }


def _figure_parts(backend: str, gaussians: int, size: int, seed: int) -> dict[str, Callable[[], object]]:
    """Returns a figure of a person over black: where it can differ from black alone, and of the whole picture."""
    metric, scene = load_perceptual("stlpips"), make_scene(SceneSize(gaussians, size), seed)
    with torch.no_grad():
        picture = rasterize(**scene.arguments(scene.leaves()), backend=backend).rgb.clamp(0, 1)
    other = 0.9 * picture
    return {
        f"{metric.name} figure, {size} px, over black": lambda: metric.over_black(picture, other),
        f"{metric.name} figure, {size} px, whole": lambda: metric(picture, other),
    }


def _perceptual_parts(picture: Tensor, target: Tensor, box: Box) -> dict[str, Callable[[], object]]:
    metric = load_perceptual("stlpips")
    side = min(PERCEPTUAL_CROP, *box[2:])
    window = (slice(0, side), slice(0, side))
    kept = metric.features(target[window])

    def both() -> None:
        metric(picture[window].clone().requires_grad_(), target[window]).backward()

    def with_kept_target() -> None:
        metric.distance(picture[window].clone().requires_grad_(), kept).backward()

    return {
        f"{metric.name}, {side} px": both,
        f"{metric.name}, {side} px, target's features kept": with_kept_target,
    }
