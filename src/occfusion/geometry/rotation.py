"""Rotations as axis-angles, matrices and quaternions (w, x, y, z); exact, with finite gradients, everywhere.

The delicate places are the axis-angle 0, where `sin(a) / a` needs its series, rotations by pi, where an axis
has to be read from a matrix whose skew part vanishes, and quaternions of length 0. Each branch that is not
taken is fed harmless numbers, because `torch.where` lets the gradient of the branch it drops turn into NaN.
"""

from __future__ import annotations

import torch
from torch import Tensor

_SERIES_BELOW = 1e-2
"""Squared angle under which series are used: the first term left out is below 1e-17 there."""

QUATERNION_FLOOR = 1e-12
"""Quaternions shorter than this count as the identity: their direction is rounding noise."""

# Maps a vector to the 9 entries (row-major) of its cross-product matrix.
_SKEW = torch.zeros(3, 9, dtype=torch.float64)
for _component, _entry, _factor in ((0, 5, -1), (0, 7, 1), (1, 2, 1), (1, 6, -1), (2, 1, -1), (2, 3, 1)):
    _SKEW[_component, _entry] = _factor

# Maps the 16 products q_i q_j of a unit quaternion to the 9 entries of its matrix (row-major both).
_PRODUCTS_TO_MATRIX = torch.zeros(16, 9, dtype=torch.float64)
for _product, _entry, _factor in (
    *((0, 0, 1), (5, 0, 1), (10, 0, -1), (15, 0, -1)),  # ww + xx - yy - zz
    *((0, 4, 1), (5, 4, -1), (10, 4, 1), (15, 4, -1)),
    *((0, 8, 1), (5, 8, -1), (10, 8, -1), (15, 8, 1)),
    *((6, 1, 2), (3, 1, -2), (6, 3, 2), (3, 3, 2)),  # 2 (xy -+ wz)
    *((7, 2, 2), (2, 2, 2), (7, 6, 2), (2, 6, -2)),  # 2 (xz +- wy)
    *((11, 5, 2), (1, 5, -2), (11, 7, 2), (1, 7, 2)),  # 2 (yz -+ wx)
):
    _PRODUCTS_TO_MATRIX[_product, _entry] = _factor


def axis_angle_to_matrix(vectors: Tensor, *, compiled: bool = False) -> Tensor:
    """Returns the rotation matrices of axis-angle vectors (Rodrigues' formula).

    Args:
        vectors: axis times angle in radians, `[..., 3]`; any angle.
        compiled: by the kernels of `rotation_kernels.py`, of which this is the specification, where they take the
            vectors: float32. Those of a GPU come to the host and go back: a few vectors for forty launches each way.

    Returns:
        `[..., 3, 3]`.
    """
    if compiled and vectors.dtype == torch.float32 and vectors.device.type in ("cpu", "cuda"):
        # numba is loaded where it is used
        from occfusion.geometry import rotation_kernels

        matrices: Tensor = rotation_kernels.AxisAngle.apply(vectors.reshape(-1, 3).cpu())
        return matrices.view(*vectors.shape, 3).to(vectors.device)
    squared = (vectors * vectors).sum(-1, keepdim=True)
    is_small = squared < _SERIES_BELOW
    angle = torch.where(is_small, 1.0, squared).sqrt()
    half_sine = torch.sin(0.5 * angle)
    # sin(a) / a and (1 - cos(a)) / a^2; the half angle avoids the cancellation in 1 - cos(a)
    first = torch.where(is_small, _sine_ratio_series(squared), torch.sin(angle) / angle)
    second = torch.where(is_small, _cosine_ratio_series(squared), 2.0 * (half_sine / angle) ** 2)
    outer = (second * vectors).unsqueeze(-1) * vectors.unsqueeze(-2)
    identity = torch.eye(3, dtype=vectors.dtype, device=vectors.device)
    cosine = (1.0 - second * squared).unsqueeze(-1)
    return cosine * identity + outer + skew(first * vectors)


def _sine_ratio_series(squared: Tensor) -> Tensor:
    return 1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42 * (1 - squared / 72)))


def _cosine_ratio_series(squared: Tensor) -> Tensor:
    return 0.5 * (1 - squared / 12 * (1 - squared / 30 * (1 - squared / 56 * (1 - squared / 90))))


def skew(vectors: Tensor) -> Tensor:
    """Returns the matrices `[..., 3, 3]` whose product with x is the cross product of `vectors` and x."""
    return (vectors @ _SKEW.to(vectors)).unflatten(-1, (3, 3))


def normalize_quaternion(quats: Tensor) -> Tensor:
    """Returns unit quaternions `[..., 4]`; the identity (with zero gradient) where the length is below 1e-12.

    Components up to the largest finite number are fine: they are scaled down before they are squared.
    """
    largest = quats.detach().abs().amax(dim=-1, keepdim=True)
    identity = torch.zeros_like(quats)
    identity[..., 0] = 1.0
    is_usable = largest >= QUATERNION_FLOOR
    # a unit vector does not depend on the length, so the (detached) scale leaves value and gradient exact
    scaled = torch.where(is_usable, quats / largest.clamp(min=QUATERNION_FLOOR), identity)
    return scaled * (scaled * scaled).sum(-1, keepdim=True).rsqrt()


def quaternion_to_matrix(quats: Tensor) -> Tensor:
    """Returns the rotation matrices `[..., 3, 3]` of quaternions `[..., 4]`, which need not be normalised."""
    unit = normalize_quaternion(quats)
    products = (unit.unsqueeze(-1) * unit.unsqueeze(-2)).flatten(-2)
    return (products @ _PRODUCTS_TO_MATRIX.to(products)).unflatten(-1, (3, 3))


def matrix_to_quaternion(matrices: Tensor) -> Tensor:
    """Returns the unit quaternions `[..., 4]`, w not negative, of rotation matrices `[..., 3, 3]`.

    The largest of the four components is computed by a square root of at least 1, the others by division
    by it, so that no rotation is ill-conditioned.
    """
    m = matrices
    trace = m.diagonal(dim1=-2, dim2=-1).sum(-1)
    d0, d1, d2 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # four times the squared components, and for each the row 4 q_i q_j
    wx, wy, wz = (m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1])
    xy, xz, yz = (m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1])
    squares = torch.stack([1 + trace, 1 + 2 * d0 - trace, 1 + 2 * d1 - trace, 1 + 2 * d2 - trace], dim=-1)
    rows = torch.stack(
        [
            torch.stack([squares[..., 0], wx, wy, wz], dim=-1),
            torch.stack([wx, squares[..., 1], xy, xz], dim=-1),
            torch.stack([wy, xy, squares[..., 2], yz], dim=-1),
            torch.stack([wz, xz, yz, squares[..., 3]], dim=-1),
        ],
        dim=-2,
    )
    largest = squares.detach().argmax(dim=-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    unit = normalize_quaternion(rows.gather(-2, largest).squeeze(-2))
    return torch.where(unit[..., :1] < 0, -unit, unit)


def z_axis_to(directions: Tensor) -> Tensor:
    """Returns the quaternions of the shortest turns of +z to `directions [..., 3]` of length 1, `[..., 4]`, w first.

    To -z, which is half a turn whatever the axis, about x.
    """
    x, y, z = directions.unbind(-1)
    half_way = torch.stack([1.0 + z, -y, x, torch.zeros_like(z)], dim=-1)
    about_x = half_way.new_tensor([0.0, 1.0, 0.0, 0.0])
    # that near to -z the sum has lost the axis
    return normalize_quaternion(torch.where((z < -1.0 + 1e-6)[..., None], about_x, half_way))
