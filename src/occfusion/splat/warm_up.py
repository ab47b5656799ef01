"""Compiling, or loading from a cache, everything that a backend's first picture would otherwise wait for."""

from __future__ import annotations

import time

import torch

from occfusion.splat.rasterize import rasterize

SIZE = 16
"""Pixels; kernels are compiled for types of arrays, not for sizes."""


def warm_up(backend: str, device: torch.device) -> float:
    """Renders a tiny picture forwards and backwards; returns the seconds that it took.

    After this no call in float32 compiles anything: `numba` needs about ten seconds where its cache is empty and one
    where it is not, `gsplat` builds or loads its extension.

    Args:
        backend: a resolved backend, not `auto`.
        device: where it will run.
    """
    started = time.monotonic()
    with torch.inference_mode(False), torch.enable_grad():
        means = torch.tensor([[0.0, 0.0, 1.0]], device=device, requires_grad=True)
        colors = torch.ones(1, 3, device=device, requires_grad=True)
        K = torch.tensor([[SIZE, 0.0, SIZE / 2], [0.0, SIZE, SIZE / 2], [0.0, 0.0, 1.0]], device=device)
        # what a stage learns; and colours alone, by which those that the video shows are gathered at the start
        for centres, shades in ((means, colors.detach()), (means.detach(), colors)):
            rendering = rasterize(
                centres, None, None, torch.ones(1, device=device), shades,
                torch.eye(4, device=device), K, SIZE, SIZE,
                covariances=0.01 * torch.eye(3, device=device)[None], backend=backend,
            )  # fmt: skip
            (rendering.rgb.sum() + rendering.alpha.sum()).backward()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.monotonic() - started
