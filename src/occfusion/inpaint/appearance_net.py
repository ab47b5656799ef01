"""The network of the embedded inpainter: the pictures that it sees, what it predicts, and its weights."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from occfusion.geometry.camera import project_vertices
from occfusion.inpaint.partial import Partial
from occfusion.observation.bodyview import view_body
from occfusion.observation.crop import Square
from occfusion.priors.embedded.network_file import Card, load_net
from occfusion.priors.embedded.unet import BlockUNet

SIZE = 256
"""Pixels a side of the crop."""
PLANES = (
    "coarse_r", "coarse_g", "coarse_b", "alpha", "gathered_r", "gathered_g", "gathered_b", "seen", "rgb_r", "rgb_g",
    "rgb_b", "visible", "complete", "body", "depth",
)  # fmt: skip
COARSE, GATHERED, OBSERVED = slice(0, 3), slice(4, 7), slice(8, 11)
ALPHA, SEEN, VISIBLE, COMPLETE, BODY, DEPTH = 3, 7, 11, 12, 13, 14
"""Where each stands in `PLANES`; `depth` is relative, in -1..1, all others lie in 0..1."""

Planes = NDArray[np.float32]


def take_planes(partial: Partial) -> tuple[Square, Planes]:
    """Returns the square around the body, and the planes of `PLANES` in it, `[15, SIZE, SIZE]`."""
    observation = partial.observation
    camera = observation.camera
    viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    pixels, depths = project_vertices(observation.vertices, viewmat, K)
    square = Square.around(pixels[depths > 0.01])
    window = square.camera(camera, SIZE)
    body = view_body(
        *project_vertices(observation.vertices, viewmat, window.K.numpy()), observation.faces, SIZE, SIZE
    )
    whole = np.concatenate(
        [
            partial.coarse, partial.alpha[..., None], partial.gathered, partial.seen[..., None],
            np.where(observation.visible[..., None], observation.rgb, 0.0), observation.visible[..., None],
            partial.complete[..., None],
        ],
        axis=-1, dtype=np.float32,
    )  # fmt: skip
    taken = [square.take(whole[..., k], SIZE) for k in range(whole.shape[-1])]
    return square, np.stack([*taken, body.coverage, body.relative_depth]).astype(np.float32)


def take_picture(square: Square, picture: NDArray[np.floating]) -> Planes:
    """Returns a picture `[H, W, C]` in the square, `[C, SIZE, SIZE]`."""
    return np.stack([square.take(plane.astype(np.float32), SIZE) for plane in np.moveaxis(picture, -1, 0)])


KNEE = 0.015
"""Difference between truth and rendering up to which the signal grows in proportion; beyond, with its logarithm."""
SPAN = math.asinh(1.0 / KNEE)
"""Of the largest difference, 1, whose signal is 1."""


class AppearanceNet(nn.Module):
    """Predicts v of the difference between the person and its coarse rendering.

    The signal is that difference, not the person: where the rendering is good, and mostly it is, there is little to
    say, and details of the rendering finer than the crop are kept.

    Args:
        widths: channels at each level.
        depth: residual blocks of the lower levels.
    """

    def __init__(self, widths: tuple[int, ...] = (64, 96, 160), depth: int = 2) -> None:
        super().__init__()
        self.net = BlockUNet(3, 3 + len(PLANES), 0, tuple(widths), depth)

    def forward(self, noisy: Tensor, t: Tensor, planes: Tensor) -> Tensor:
        """Returns v, `[B, 3, S, S]`, for `noisy [B, 3, S, S]`, `t [B]` and `planes [B, 15, S, S]`."""
        fine = torch.cat([noisy, planes], dim=1).contiguous(memory_format=torch.channels_last)
        return self.net(fine, None, t)


def to_signal(truth: Tensor, planes: Tensor) -> Tensor:
    """Returns the signal for the true pictures `[B, 3, S, S]`, in -1..1.

    Differences are companded: most are a few hundredths or less, which a diffusion of standard noise would drown,
    while the few large ones, where an outline is wrong, would decide the fit. The mean of a companded signal lies
    towards the median, and a reference counts by L1 (paper §4.3).
    """
    return torch.asinh((truth - planes[:, COARSE]) / KNEE) / SPAN


def from_signal(signal: Tensor) -> Tensor:
    """Returns what is to be added to the coarse rendering, for signals in -1..1."""
    return KNEE * torch.sinh(SPAN * signal)


APPEARANCE = "appearance"
NETWORK_VERSION = 2
"""Of the network's conditions and prediction: 2 since its signal is companded."""


def load_appearance_net(path: str | Path | None = None) -> tuple[AppearanceNet, Card]:
    """Returns the network of the embedded inpainter, ready to evaluate, and its card; see `load_net`."""
    return load_net(path, APPEARANCE, SIZE, AppearanceNet, "prior.inpaint.weights", NETWORK_VERSION)
