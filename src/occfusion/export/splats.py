"""An avatar's Gaussians as a table of 3DGS: canonical or posed, in a light, for other footprints; as glTF points."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from occfusion.errors import DataError
from occfusion.files.glb import VERTICES, Glb
from occfusion.files.ply import SplatTable, check_table
from occfusion.geometry.rotation import matrix_to_quaternion
from occfusion.human import Avatar
from occfusion.human.gaussians import MIN_SCALE
from occfusion.splat.harmonics import COLOR_OFFSET, SH_C0, basis, num_coefficients
from occfusion.types import Pose

VIEWERS_DILATION = 0.3
"""Square pixels that viewers of 3DGS files add to each projected covariance."""
FAINTEST = 1 / 255
"""Gaussians below this opacity are never drawn."""
_DIRECTIONS = 64
EXTENSION = "KHR_gaussian_splatting"
"""Of glTF: standard deviations and opacities as they are, +y up."""


@torch.no_grad()
def canonical_table(avatar: Avatar, widen: float = 0.0) -> SplatTable:
    """Returns the Gaussians in the canonical pose, +y up, in even light; see `posed_table`."""
    gaussians = avatar.gaussians
    roots = gaussians.roots()
    return splat_table(
        gaussians.means, roots @ roots.transpose(1, 2), gaussians.opacities, gaussians.sh(avatar.active_sh_degree),
        widen,
    )  # fmt: skip


@torch.no_grad()
def posed_table(avatar: Avatar, pose: Pose, upright: Tensor, widen: float = 0.0) -> SplatTable:
    """Returns the Gaussians in a pose, in the upright frame, in the avatar's present light.

    Harmonics turn with each Gaussian by the rotation of its map; what the map stretches is left out of that, which
    the colours of our own renderings have in their viewing directions.

    Args:
        avatar: whose.
        pose: in its own world.
        upright: from that world to the frame of the table, rigid `[4, 4]`.
        widen: added to the variance in all directions, square metres; see `viewers_widening`.
    """
    carried = avatar.deform(pose)
    turn, shift = upright[:3, :3], upright[:3, 3]
    linear = turn @ carried.linear.permute(2, 0, 1)
    sh = avatar.gaussians.sh(avatar.active_sh_degree).clone()
    if avatar.active_sh_degree > 0:
        u, _, v = torch.linalg.svd(linear)
        rotations = u @ v
        rotations = rotations * torch.linalg.det(rotations).sign()[:, None, None]
        sh = turned_harmonics(sh, rotations)
    shade = avatar.brightness(carried)
    if shade is not None:
        sh *= shade[:, None, None]
        sh[:, 0] += (shade[:, None] - 1.0) * COLOR_OFFSET / SH_C0
    covariances = turn @ carried.covariances @ turn.T
    return splat_table(carried.means @ turn.T + shift, covariances, avatar.gaussians.opacities, sh, widen)


def turned_harmonics(sh: Tensor, rotations: Tensor) -> Tensor:
    """Returns coefficients `[N, K, 3]` of the same colours seen after each Gaussian turned by `rotations [N, 3, 3]`.

    A band of harmonics is closed under rotation, so values in a fixed set of directions determine the coefficients.
    """
    degree = math.isqrt(sh.shape[1]) - 1
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(_DIRECTIONS, 3, generator=generator, dtype=torch.float64)
    directions = directions / directions.norm(dim=1, keepdim=True)
    back = torch.linalg.pinv(basis(directions, degree))
    before = basis(directions @ rotations.double(), degree)  # directions taken back by each rotation
    return (back @ before @ sh.double()).to(sh)


def viewers_widening(dilation: float, pixel: float) -> float:
    """Returns what a viewer with its own 0.3 square pixels lacks of a footprint, square metres; may be negative.

    Args:
        dilation: of the picture that it shall show, square pixels.
        pixel: of that picture, at the person, metres.
    """
    return (dilation - VIEWERS_DILATION) * pixel**2


def splat_table(
    means: Tensor, covariances: Tensor, opacities: Tensor, sh: Tensor, widen: float
) -> SplatTable:
    """Returns the table of Gaussians given by covariances; what is faint or not finite is left out.

    Args:
        means: `[N, 3]`, metres.
        covariances: `[N, 3, 3]`, square metres.
        opacities: `[N]`.
        sh: `[N, K, 3]`.
        widen: added to all variances, square metres.
    """
    variances, axes = torch.linalg.eigh(covariances.double())
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    scales = (variances + widen).clamp_min(MIN_SCALE**2).sqrt()
    columns = [means, sh.flatten(1), opacities[:, None], scales]
    kept = torch.cat([column.double() for column in columns], dim=1).isfinite().all(dim=1)
    kept &= opacities >= FAINTEST
    count = num_coefficients(math.isqrt(sh.shape[1]) - 1)

    def rows(values: Tensor) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        return np.ascontiguousarray(values[kept].float().cpu().numpy())

    return SplatTable(
        means=rows(means),
        raw_quats=rows(matrix_to_quaternion(axes)),
        log_scales=rows(scales.log()),
        opacity_logits=rows(torch.logit(opacities.double(), eps=1e-6)),
        sh0=rows(sh[:, :1]),
        sh_rest=rows(sh[:, 1:count]),
    )


def write_splat_glb(path: Path | str, table: SplatTable) -> None:
    """Writes the Gaussians whole or not at all; programs without the extension show coloured points.

    Raises:
        DataError: a value is not finite, the arrays do not fit together, there are none, or the disk refuses.
    """
    count = check_table(path, table)
    if not len(table.means):
        raise DataError(f"{path}: no Gaussians, and glTF has no empty arrays")
    opacities = (1.0 / (1.0 + np.exp(-table.opacity_logits.astype(np.float64)))).astype(np.float32)
    quats = np.roll(table.raw_quats, -1, axis=1)  # w, x, y, z to x, y, z, w
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    shown = np.concatenate([table.sh0[:, 0] * SH_C0 + COLOR_OFFSET, opacities[:, None]], axis=1)
    glb = Glb()
    attributes: dict[str, Any] = {
        "POSITION": glb.add(table.means, target=VERTICES, bounds=True),
        "COLOR_0": glb.add(
            (255 * shown.clip(0, 1)).round().astype(np.uint8), target=VERTICES, normalized=True
        ),
        f"{EXTENSION}:ROTATION": glb.add(quats.astype(np.float32), target=VERTICES),
        f"{EXTENSION}:SCALE": glb.add(np.exp(table.log_scales), target=VERTICES),
        f"{EXTENSION}:OPACITY": glb.add(opacities, target=VERTICES),
    }
    coefficients = np.concatenate([table.sh0, table.sh_rest], axis=1)
    for degree in range(4):
        for k, index in enumerate(range(degree**2, min((degree + 1) ** 2, count))):
            semantic = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}"
            attributes[semantic] = glb.add(np.ascontiguousarray(coefficients[:, index]), target=VERTICES)
    kernel = {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }  # fmt: skip
    said = {"extras": {"about": table.about}} if table.about else {}
    points = {"mode": 0, "attributes": attributes, "extensions": {EXTENSION: kernel}}
    glb.document = {
        "extensionsUsed": [EXTENSION], "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "avatar", "mesh": 0, **said}], "meshes": [{"primitives": [points]}],
    }  # fmt: skip
    glb.write(path)
