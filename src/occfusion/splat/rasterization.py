"""The one entry point: Gaussians and a camera in, colour, alpha and depth out."""

from __future__ import annotations

import torch
from torch import Tensor

from occfusion.errors import ConfigError
from occfusion.splat.backends.registry import render_with, resolve_backend
from occfusion.splat.limits import DEFAULT_LIMITS, NEAR, Limits
from occfusion.splat.once import refuse_transforms
from occfusion.splat.request import Request, check_request, check_rigid, check_values, read_intrinsics
from occfusion.types import Box, Rendering


def rasterize(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    background: Tensor | None = None,
    sh_degree: int | None = None,
    covariances: Tensor | None = None,
    backend: str = "auto",
    *,
    crop: Box | None = None,
    screen_offsets: Tensor | None = None,
    antialiased: bool = False,
    near: float = NEAR,
    limits: Limits = DEFAULT_LIMITS,
) -> Rendering:
    """Returns the picture of Gaussians by 3D Gaussian splatting (Kerbl et al. 2023, eq. 3-6).

    Differentiable in every tensor but `K`. Gaussians behind the near plane, off the picture or too
    faint to see are left out and get exactly zero gradient. Equal depths are blended in input order.

    Args:
        means: centres in metres, world frame, `[N, 3]`, float32 or float64.
        quats: rotations as w, x, y, z, need not be normalised, `[N, 4]`; None with `covariances`.
        scales: standard deviations in metres, `[N, 3]`; None with `covariances`.
        opacities: `[N]`, 0..1.
        colors: `[N, 3]` in 0..1, or harmonics coefficients `[N, K, 3]` with `sh_degree`.
        viewmat: world to camera, OpenCV axes, rigid, `[4, 4]`.
        K: intrinsics in pixels, `[3, 3]`, without skew; pixel centres lie at +0.5.
        width: picture width in pixels.
        height: picture height in pixels.
        background: colour behind everything, `[3]`; black when None.
        sh_degree: bands of the harmonics to use, 0..3.
        covariances: `[N, 3, 3]` in square metres, in place of quats and scales.
        backend: `auto`, `torch`, `numba` (CPU, float32) or `gsplat` (CUDA, float32).
        crop: window `(x, y, width, height)` to compute; equals that slice of the full picture.
        screen_offsets: `[N, 2]` pixels added to the projected centres; pass zeros that require a
            gradient to learn how each splat wants to move on the picture.
        antialiased: scale opacities so that the 0.3 px^2 dilation keeps each splat's mass; for
            splats of about a pixel and smaller.
        near: depth in metres at or below which Gaussians are culled.
        limits: the cut-offs of the image formation.

    Raises:
        ConfigError: wrong shape, dtype or device, singular `K`, unknown or unsuitable backend; called within
            `torch.func`, or a gradient of its gradient is asked for.
        NumericsError: an input holds NaN, infinity, or what cannot be: an opacity outside 0..1, a camera that is not
            rigid, a covariance that is not one.
    """
    refuse_transforms()
    needed = {"means": means, "opacities": opacities, "colors": colors, "viewmat": viewmat, "K": K}
    for name, tensor in needed.items():
        if not isinstance(tensor, Tensor):
            raise ConfigError(f"rasterize: {name} must be a tensor, got {type(tensor).__name__}")
    check_rigid(viewmat)
    request = Request(
        means=means, quats=quats, scales=scales, opacities=opacities, colors=colors,
        viewmat=viewmat.to(means), intrinsics=read_intrinsics(K), width=width, height=height,
        crop=(0, 0, width, height) if crop is None else crop, sh_degree=sh_degree,
        covariances=covariances, screen_offsets=screen_offsets,
        background=None if background is None else background.to(means), antialiased=antialiased,
        near=near, limits=limits,
    )  # fmt: skip
    check_request(request)
    check_values(request)
    with torch.autocast(means.device.type, enabled=False):  # bfloat16 is 4e-3 off, in silence
        return render_with(resolve_backend(backend, means.device, means.dtype), request)
