"""Gaussians carried by affine maps, with the gradient written out.

The same as composing `rotation.quaternion_to_matrix`, `skinning.skin_points` and `skinning.skin_covariances`,
and tested against them; but with one column a Gaussian (`[3, 3, N]`, not `[N, 3, 3]`) each product of 3 x 3
matrices is three passes over long rows, and what autograd would keep and sum on the way is left out: a fifth
of the time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from occfusion.geometry.rotation import QUATERNION_FLOOR


class Carried(NamedTuple):
    """Gaussians carried into a pose.

    Attributes:
        means: centres, `[N, 3]`, metres.
        covariances: `[N, 3, 3]`, square metres.
        linear: linear part of the whole map, `[3, 3, N]`.
    """

    means: Tensor
    covariances: Tensor
    linear: Tensor


def carry(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    rest_maps: Tensor,
    offsets: Tensor,
    posed_maps: Tensor,
    *,
    compiled: bool = True,
) -> Carried:
    """Returns Gaussians moved to rest, displaced there, and moved into a pose (paper §3.1).

    A centre x becomes `P (A x + a + d) + p`, a covariance `(P A) S (P A)^t`. Nothing is inverted here.

    Args:
        means: canonical centres, `[N, 3]`, metres.
        quats: rotations, `[N, 4]`, of any length.
        scales: standard deviations, `[N, 3]`, metres.
        rest_maps: canonical to rest, A and a, `[3, 4, N]`.
        offsets: displacements d at rest, `[N, 3]`, metres.
        posed_maps: rest to posed, P and p, `[3, 4, N]`.
        compiled: by the kernels of `carry_kernels.py`, of which this is the specification, where they take the
            Gaussians: float32 on a CPU.
    """
    if compiled and means.dtype == torch.float32 and means.device.type == "cpu":
        # numba is loaded where it is used
        from occfusion.human import carry_kernels

        return Carried(*carry_kernels.Carry.apply(means, quats, scales, rest_maps, offsets, posed_maps))
    return Carried(*_Carry.apply(means, quats, scales, rest_maps, offsets, posed_maps))


def blend_columns(weights: Tensor, transforms: Tensor, shift: Tensor) -> Tensor:
    """Returns each Gaussian's blended affine map, `[3, 4, N]`: `skinning.blend`, one column a Gaussian.

    Args:
        weights: skinning weights, `[N, 24]`.
        transforms: bone transforms, `[24, 4, 4]`.
        shift: added to all, `[3]`, metres.
    """
    moved = torch.cat([transforms[:, :3, :3], (transforms[:, :3, 3] + shift).unsqueeze(-1)], dim=-1)
    return (moved.flatten(1).T @ weights.T).unflatten(0, (3, 4))


class _Carry(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        rest_maps: Tensor,
        offsets: Tensor,
        posed_maps: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.set_materialize_grads(False)
        centres, sizes = _columns(means), _columns(scales)
        unit, inverse_length = _normalized(_columns(quats))
        posed, rest = posed_maps[:, :3], rest_maps[:, :3]
        at_rest = _apply(rest, centres) + rest_maps[:, 3] + offsets.T
        linear = _product(posed, rest)
        root = _product(linear, _rotation(unit) * sizes)
        ctx.save_for_backward(centres, sizes, unit, inverse_length, rest, posed, at_rest, linear, root)
        moved = _apply(posed, at_rest) + posed_maps[:, 3]
        return _rows(moved), _rows(_product(root, root.transpose(0, 1))), linear

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        for_means, for_covariances, for_linear = gradients
        centres, sizes, unit, inverse_length, rest, posed, at_rest, linear, root = ctx.saved_tensors
        to_linear = torch.zeros_like(linear) if for_linear is None else for_linear
        to_quats = to_scales = None
        if for_covariances is not None:
            each = for_covariances.permute(1, 2, 0)
            to_root = _product((each + each.transpose(0, 1)).contiguous(), root)
            rotation = _rotation(unit)
            to_linear = to_linear + _product(to_root, (rotation * sizes).transpose(0, 1))
            to_own = _product(linear.transpose(0, 1), to_root)
            to_scales = _rows((to_own * rotation).sum(dim=0))
            to_quats = _rows(_to_quaternion(to_own * sizes, unit) * inverse_length)
        to_posed_linear = _product(to_linear, rest.transpose(0, 1))
        to_rest_linear = _product(posed.transpose(0, 1), to_linear) if ctx.needs_input_grad[3] else None
        moved = torch.zeros_like(centres) if for_means is None else _columns(for_means)
        to_rest = _apply(posed.transpose(0, 1), moved)
        to_posed_linear = to_posed_linear + moved.unsqueeze(1) * at_rest
        to_rest_maps = None
        if to_rest_linear is not None:
            to_rest_maps = _with_shift(to_rest_linear + to_rest.unsqueeze(1) * centres, to_rest)
        to_means = _apply(rest.transpose(0, 1), to_rest)
        return (
            _rows(to_means), to_quats, to_scales, to_rest_maps, _rows(to_rest),
            _with_shift(to_posed_linear, moved),
        )  # fmt: skip


def _columns(rows: Tensor) -> Tensor:
    return rows.T.contiguous()


def _rows(columns: Tensor) -> Tensor:
    """`[..., N]` to `[N, ...]`."""
    return columns.movedim(-1, 0).contiguous()


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Matrix products of `[3, 3, N]` and `[3, K, N]`."""
    total = a[:, 0, None] * b[0]
    total.addcmul_(a[:, 1, None], b[1])
    return total.addcmul_(a[:, 2, None], b[2])


def _apply(a: Tensor, x: Tensor) -> Tensor:
    """Matrices `[3, 3, N]` times vectors `[3, N]`."""
    total = a[:, 0] * x[0]
    total.addcmul_(a[:, 1], x[1])
    return total.addcmul_(a[:, 2], x[2])


def _with_shift(linear: Tensor, shift: Tensor) -> Tensor:
    return torch.cat([linear, shift.unsqueeze(1)], dim=1)


def _normalized(quats: Tensor) -> tuple[Tensor, Tensor]:
    """Returns unit quaternions `[4, N]` and 1 / length `[N]`; the identity and 0 without a direction."""
    largest = quats.abs().amax(dim=0)
    is_usable = largest >= QUATERNION_FLOOR
    bounded = largest.clamp(min=QUATERNION_FLOOR)
    scaled = quats / bounded * is_usable
    scaled[0] += ~is_usable
    inverse = scaled.square().sum(dim=0).rsqrt()
    return scaled * inverse, inverse / bounded * is_usable


def _rotation(unit: Tensor) -> Tensor:
    """Rotation matrices `[3, 3, N]` of unit quaternions `[4, N]`."""
    w, x, y, z = unit
    double = 2 * unit[1:]
    wx, wy, wz = double * w
    xx, xy, xz = double * x
    yy, yz, zz = double[1] * y, double[2] * y, double[2] * z
    entries = [
        *(1 - (yy + zz), xy - wz, xz + wy),
        *(xy + wz, 1 - (xx + zz), yz - wx),
        *(xz - wy, yz + wx, 1 - (xx + yy)),
    ]
    return torch.stack(entries).unflatten(0, (3, 3))


def _to_quaternion(gradient: Tensor, unit: Tensor) -> Tensor:
    """Gradient `[4, N]` for a unit quaternion, its tangent part, from that for its matrix `[3, 3, N]`."""
    w, x, y, z = unit
    (a, b, c), (d, e, f), (g, h, i) = gradient
    wx, wy, wz = h - f, c - g, d - b  # odd parts go with w, even parts pair the others
    xy, xz, yz = b + d, c + g, f + h
    rows = [
        x * wx + y * wy + z * wz,
        w * wx + y * xy + z * xz - 2 * x * (e + i),
        w * wy + x * xy + z * yz - 2 * y * (a + i),
        w * wz + x * xz + y * yz - 2 * z * (a + e),
    ]
    total = 2 * torch.stack(rows)
    return total - unit * (total * unit).sum(dim=0)
