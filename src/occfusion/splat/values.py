"""What inputs of the rasteriser may hold; each check is a pass or two over its tensor."""

from __future__ import annotations

from operator import mul

import torch
from torch import Tensor

from occfusion.errors import NumericsError
from occfusion.splat.request import Request

FARTHEST = 1e30
"""Metres: beyond, squares of single precision overflow, and gradients are NaN."""
RIGID = 1e-3
"""How far a camera's axes may be from length 1 and right angles."""
CORRELATED = 1e-2
"""How far beyond 1 correlations of a covariance may be: those of needles in single precision are by rounding."""


@torch.no_grad()
def check_values(request: Request) -> None:
    """Refuses values that would spread over the picture, or have no meaning.

    Raises:
        NumericsError: naming the argument and how many rows are affected.
    """
    named = {**request.gaussian_tensors(), "viewmat": request.viewmat}
    if request.background is not None:
        named["background"] = request.background
    for name, values in named.items():
        # one fast pass for the usual case: a sum with NaN or infinity in it is not finite
        if not bool(values.sum().isfinite()) and not bool(values.isfinite().all()):
            rows = int((~values.isfinite()).sum())
            raise NumericsError(f"rasterize: {name} holds {rows} values that are NaN or infinite")
    if not len(request.means):
        return
    _refuse(request.means[:, 2].abs() > FARTHEST, f"means: {{}} are farther away than {FARTHEST:g} m")
    low, high = request.opacities.aminmax()
    if low < 0 or high > 1:
        outside = (request.opacities < 0) | (request.opacities > 1)
        _refuse(outside, "opacities: {} are outside 0..1; give probabilities, not logits")
    # those that come out of a computation, as a posed body's, are factors times their transposes: 3 % of a step saved
    if request.covariances is not None and request.covariances.grad_fn is None:
        _refuse(_indefinite(request.covariances), "covariances: {} have a negative eigenvalue")
    _check_rigid(request.viewmat)


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


def _check_rigid(viewmat: Tensor) -> None:
    *rows, last = viewmat.tolist()
    x, y, z = (row[:3] for row in rows)
    products = [sum(map(mul, p, q)) for p, q in ((x, x), (y, y), (z, z), (x, y), (y, z), (z, x))]
    wanted = [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    handed = (
        z[0] * (x[1] * y[2] - x[2] * y[1])
        + z[1] * (x[2] * y[0] - x[0] * y[2])
        + z[2] * (x[0] * y[1] - x[1] * y[0])
    )
    found = [*products, handed, *last]
    if max(abs(a - b) for a, b in zip(found, [*wanted, 1.0, 0.0, 0.0, 0.0, 1.0], strict=True)) > RIGID:
        raise NumericsError(
            "rasterize: viewmat is not rigid: its first three rows must be a rotation and a translation in metres, its "
            "last 0, 0, 0, 1"
        )
