"""One checked call of the rasteriser, as the backends receive it.

Each check of what tensors hold is a pass or two over them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from occfusion.errors import ConfigError, NumericsError
from occfusion.gpu.sums import total
from occfusion.splat.harmonics import MAX_DEGREE, num_coefficients
from occfusion.splat.limits import DEFAULT_LIMITS, NEAR, Limits
from occfusion.types import Box

GAUSSIAN_TENSORS = ("means", "quats", "scales", "opacities", "colors", "covariances", "screen_offsets")
"""Fields of a `Request` with one row a Gaussian."""
FARTHEST = 1e30
"""Metres: beyond, squares of single precision overflow, and gradients are NaN."""
RIGID = 1e-3
"""How far a camera's axes may be from length 1 and right angles."""
CORRELATED = 1e-2
"""How far beyond 1 correlations of a covariance may be: those of needles in single precision are by rounding."""


class Intrinsics(NamedTuple):
    """Focal lengths and principal point in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class Request:
    """Gaussians, camera and options; tensors share one dtype and device.

    Attributes:
        means: centres, `[N, 3]`, metres, world frame.
        quats: `[N, 4]`, w x y z, any norm; None with `covariances`.
        scales: standard deviations, `[N, 3]`, metres; None with `covariances`.
        opacities: `[N]`, 0..1.
        colors: `[N, 3]`, or harmonics coefficients `[N, K, 3]` with `sh_degree`.
        viewmat: world to camera, `[4, 4]`.
        intrinsics: focal lengths and principal point of the full picture, pixels.
        width: of the full picture, pixels.
        height: of the full picture, pixels.
        crop: the window that is wanted, `(x, y, width, height)` in the full picture.
        sh_degree: active harmonics degree, None when `colors` are colours.
        covariances: `[N, 3, 3]`, square metres, or None.
        screen_offsets: `[N, 2]` pixels, added to the projected centres, or None.
        background: colour behind everything, `[3]`; black when None.
        antialiased: whether the dilation keeps a splat's mass (its opacity is scaled).
        near: depth in metres at or below which Gaussians are culled.
        limits: cut-offs of the image formation.
    """

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    colors: Tensor
    viewmat: Tensor
    intrinsics: Intrinsics
    width: int
    height: int
    crop: Box
    sh_degree: int | None = None
    covariances: Tensor | None = None
    screen_offsets: Tensor | None = None
    background: Tensor | None = None
    antialiased: bool = False
    near: float = NEAR
    limits: Limits = DEFAULT_LIMITS

    def rows(self, index: Tensor) -> Request:
        """Returns the request for the Gaussians `index` `[V]` alone, in that order."""
        chosen = {name: rows.index_select(0, index) for name, rows in self.gaussian_tensors().items()}
        return replace(self, **chosen)  # type: ignore[arg-type]

    def in_double(self) -> Request:
        """Returns the request with the geometry, all but the colours, in float64; differentiable."""
        geometry = {**self.gaussian_tensors(), "viewmat": self.viewmat}
        del geometry["colors"]
        return replace(self, **{name: tensor.double() for name, tensor in geometry.items()})  # type: ignore[arg-type]

    def gaussian_tensors(self) -> dict[str, Tensor]:
        """Returns the per-Gaussian inputs that are given, by name."""
        named = {name: getattr(self, name) for name in GAUSSIAN_TENSORS}
        return {name: tensor for name, tensor in named.items() if tensor is not None}


def check_request(request: Request) -> None:
    """Refuses inputs that no backend can honour.

    Raises:
        ConfigError: naming the argument, what was given and what is wanted.
    """
    _check_kinds(request)
    _check_shapes(request)
    x, y, w, h = request.crop
    if request.width < 1 or request.height < 1:
        raise ConfigError(f"rasterize: a picture of {request.width} x {request.height} pixels is empty")
    if not all(isinstance(part, int) for part in (*request.crop, request.width, request.height)):
        raise ConfigError(f"rasterize: crop {request.crop} must be whole numbers of pixels")
    if w < 1 or h < 1 or x < 0 or y < 0 or x + w > request.width or y + h > request.height:
        raise ConfigError(
            f"rasterize: crop (x, y, width, height) = {request.crop} is not inside the"
            f" {request.width} x {request.height} picture; clip it first"
        )
    if not request.near > 0:
        raise ConfigError(f"rasterize: near must be a positive depth in metres, got {request.near}")


def _check_kinds(request: Request) -> None:
    has_factors = request.quats is not None and request.scales is not None
    if (request.covariances is None) != has_factors or (request.quats is None) != (request.scales is None):
        raise ConfigError("rasterize: give either quats and scales, or covariances")
    means = request.means
    if means.dtype not in (torch.float32, torch.float64):
        raise ConfigError(f"rasterize: means must be float32 or float64, not {means.dtype}")
    for name, tensor in request.gaussian_tensors().items():
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise ConfigError(
                f"rasterize: {name} is {tensor.dtype} on {tensor.device},"
                f" but means is {means.dtype} on {means.device}"
            )


def _check_shapes(request: Request) -> None:
    n = request.means.shape[0] if request.means.ndim else -1
    wanted: dict[str, tuple[int, ...]] = {
        "means": (n, 3),
        "quats": (n, 4),
        "scales": (n, 3),
        "opacities": (n,),
        "covariances": (n, 3, 3),
        "screen_offsets": (n, 2),
    }
    for name, tensor in request.gaussian_tensors().items():
        if name in wanted and tuple(tensor.shape) != wanted[name]:
            raise ConfigError(f"rasterize: {name} has shape {tuple(tensor.shape)}, expected {wanted[name]}")
    if tuple(request.viewmat.shape) != (4, 4):
        raise ConfigError(f"rasterize: viewmat has shape {tuple(request.viewmat.shape)}, expected (4, 4)")
    if request.background is not None and tuple(request.background.shape) != (3,):
        raise ConfigError(f"rasterize: background has shape {tuple(request.background.shape)}, expected (3,)")
    _check_colors(request.colors, n, request.sh_degree)


def _check_colors(colors: Tensor, n: int, sh_degree: int | None) -> None:
    shape = tuple(colors.shape)
    if sh_degree is None:
        if shape != (n, 3):
            raise ConfigError(f"rasterize: colors has shape {shape}, expected {(n, 3)} without sh_degree")
        return
    if not 0 <= sh_degree <= MAX_DEGREE:
        raise ConfigError(f"rasterize: sh_degree must be 0..{MAX_DEGREE}, got {sh_degree}")
    least = num_coefficients(sh_degree)
    if colors.ndim != 3 or shape[0] != n or shape[1] < least or shape[2] != 3:
        raise ConfigError(f"rasterize: colors has shape {shape}, sh_degree needs ({n}, {least} or more, 3)")


@torch.no_grad()
def check_values(request: Request) -> None:
    """Refuses values that would spread over the picture, or have no meaning.

    Raises:
        NumericsError: naming the argument and how many rows are affected.
    """
    named = {**request.gaussian_tensors(), "viewmat": request.viewmat}
    if request.background is not None:
        named["background"] = request.background
    # one fast pass for the usual case: a sum with NaN or infinity in it is not finite. A device is asked once
    ends = [*request.means.aminmax(), *request.opacities.aminmax()] if len(request.means) else []
    whole, *ends_found = torch.stack([total(named.values()), *ends]).tolist()
    if not math.isfinite(whole):
        for name, values in named.items():
            if rows := int((~values.isfinite()).sum()):
                raise NumericsError(f"rasterize: {name} holds {rows} values that are NaN or infinite")
    if not len(request.means):
        return
    nearest, farthest, low, high = ends_found
    if max(-nearest, farthest) > FARTHEST:
        far = (request.means.abs() > FARTHEST).any(dim=1)
        _refuse(far, f"means: {{}} are farther away than {FARTHEST:g} m")
    if low < 0 or high > 1:
        outside = (request.opacities < 0) | (request.opacities > 1)
        _refuse(outside, "opacities: {} are outside 0..1; give probabilities, not logits")
    # those that come out of a computation, as a posed body's, are factors times their transposes: 3 % of a step saved
    if request.covariances is not None and request.covariances.grad_fn is None:
        _refuse(_indefinite(request.covariances), "covariances: {} have a negative eigenvalue")


def _refuse(wrong: Tensor, text: str) -> None:
    if bool(wrong.any()):
        raise NumericsError(f"rasterize: {text.format(int(wrong.sum()))}")


def _indefinite(covariances: Tensor) -> Tensor:
    """Returns which matrices are no covariances, by their correlations, bool `[N]`."""
    # rows of one entry each: operations on neighbours in memory take a third of the time
    xx, xy, xz, _, yy, yz, _, _, zz = covariances.reshape(-1, 9).T.contiguous().unbind()
    least = torch.finfo(xx.dtype).tiny
    x, y, z = (part.clamp_min(least) for part in (xx, yy, zz))
    a, b, c = xy / (x * y).sqrt_(), xz / (x * z).sqrt_(), yz / (y * z).sqrt_()
    aa, bb, cc = a * a, b * b, c * c
    beyond = torch.maximum(torch.maximum(aa, bb), cc) > 1 + 2 * CORRELATED
    determinant = 1 + 2 * a * b * c - aa - bb - cc
    negative = torch.minimum(torch.minimum(xx, yy), zz) < 0
    return negative | beyond | (determinant < -4 * CORRELATED)


def check_rigid(viewmat: Tensor) -> None:
    """Refuses a camera whose axes are not of length 1 and at right angles; best asked where the camera is given.

    Raises:
        NumericsError: saying so.
    """
    rows = viewmat.tolist() if tuple(viewmat.shape) == (4, 4) else []
    if rows and all(map(math.isfinite, chain.from_iterable(rows))):  # what else is wrong the other checks say
        _check_rigid(tuple(map(tuple, rows)))


@lru_cache(maxsize=256)  # a video has one camera; what is refused is refused again
def _check_rigid(viewmat: tuple[tuple[float, ...], ...]) -> None:
    view = np.array(viewmat)
    axes, identity = view[:3, :3], np.eye(4)
    off = [*(axes @ axes.T - identity[:3, :3]).flat, np.linalg.det(axes) - 1.0, *(view[3] - identity[3])]
    if np.abs(off).max() > RIGID:
        raise NumericsError(
            "rasterize: viewmat is not rigid: its first three rows must be a rotation and a translation in metres, its "
            "last 0, 0, 0, 1"
        )


def read_intrinsics(K: Tensor) -> Intrinsics:
    """Returns focal lengths and principal point of a `[3, 3]` matrix; the gradient stops here.

    Raises:
        ConfigError: when the matrix is not `[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]` with positive,
            finite focal lengths.
    """
    if tuple(K.shape) != (3, 3):
        raise ConfigError(f"rasterize: K has shape {tuple(K.shape)}, expected (3, 3)")
    (fx, skew, cx), (yx, fy, cy), bottom = K.detach().double().cpu().tolist()
    finite = all(abs(value) < float("inf") for value in (fx, fy, cx, cy))
    if not finite or fx <= 0 or fy <= 0 or skew != 0 or yx != 0 or bottom != [0.0, 0.0, 1.0]:
        raise ConfigError(
            "rasterize: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths,"
            f" without skew; got {K.tolist()}"
        )
    return Intrinsics(fx, fy, cx, cy)
