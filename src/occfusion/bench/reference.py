"""A dense float64 renderer to measure errors against: no tiles, no factorisation, no early exit.

Written from the image formation in `docs/reference/conventions.md` and sharing no code with the backends: the inverse
of the projected covariance is explicit, every pixel meets every Gaussian that can reach its row with an alpha
that counts, and autograd differentiates each line.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from occfusion.bench.scenes import BenchScene
from occfusion.splat.limits import DEFAULT_LIMITS, FRUSTUM_MARGIN, NEAR, Limits

PAIRS_AT_A_TIME = 2_000_000
"""Pixel-Gaussian pairs blended at once: about 300 MB with the graph."""
_BANDS = (
    (0.28209479177387814,),
    (-0.4886025119029199, 0.4886025119029199, -0.4886025119029199),
    (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396),
    (-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658,
     1.445305721320277, -0.5900435899266435),
)  # fmt: skip
"""Normalisations of the real spherical harmonics, with the Condon-Shortley phase of 3DGS."""


@dataclass(frozen=True)
class Reference:
    """Pictures and gradients in float64.

    Attributes:
        rgb: `[H, W, 3]`.
        alpha: `[H, W]`.
        depth: `[H, W]`, metres.
        gradients: of the scene's scalar with respect to each input, by name.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    gradients: dict[str, Tensor]


def dense_reference(scene: BenchScene, limits: Limits = DEFAULT_LIMITS) -> Reference:
    """Returns the scene's pictures and gradients; minutes for large scenes, by design."""
    leaves = scene.leaves(torch.float64)
    splats = _project(leaves, scene, limits)
    detached = [s.detach().requires_grad_() for s in splats]
    height, width = scene.camera.height, scene.camera.width
    pictures = [torch.zeros(height, width, c, dtype=torch.float64) for c in (3, 1, 1)]
    with torch.no_grad():
        reach = _rows_reached(detached, limits)
    row = 0
    while row < height:
        rows = 1
        chosen = (reach[0] <= row + 1) & (reach[1] >= row)
        while row + rows < height and rows * width * max(int(chosen.sum()), 1) < PAIRS_AT_A_TIME:
            rows += 1
            chosen = (reach[0] <= row + rows) & (reach[1] >= row)
        block = _blend([d[chosen] for d in detached], row, rows, width, limits)
        for picture, part in zip(pictures, block, strict=True):
            picture[row : row + rows] = part.detach()
        weights = [w.double()[row : row + rows].view(rows, width, -1) for w in scene.cotangents]
        torch.stack([(w * p).sum() for w, p in zip(weights, block, strict=True)]).sum().backward()
        row += rows
    torch.autograd.backward(
        list(splats), [torch.zeros_like(d) if d.grad is None else d.grad for d in detached]
    )
    gradients = {k: torch.zeros_like(v) if v.grad is None else v.grad for k, v in leaves.items()}
    return Reference(pictures[0], pictures[1][..., 0], pictures[2][..., 0], gradients)


def _project(inputs: dict[str, Tensor], scene: BenchScene, limits: Limits) -> tuple[Tensor, ...]:
    """Returns centre, inverse covariance, opacity, colour and depth of the Gaussians in front, by depth."""
    camera = scene.camera
    view, K = camera.viewmat.double(), camera.K.double()
    points = inputs["means"] @ view[:3, :3].T + view[:3, 3]
    order = torch.argsort(points[:, 2].detach(), stable=True)
    order = order[points[order, 2].detach() > NEAR]
    x, y, z = points[order].unbind(1)
    means2d = torch.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], dim=1)
    sx = _clamped(x / z, camera.width, float(K[0, 0]), float(K[0, 2]))
    sy = _clamped(y / z, camera.height, float(K[1, 1]), float(K[1, 2]))
    zero = torch.zeros_like(z)
    jacobian = torch.stack([K[0, 0] / z, zero, -K[0, 0] * sx / z, zero, K[1, 1] / z, -K[1, 1] * sy / z], 1)
    turned = jacobian.view(-1, 2, 3) @ view[:3, :3] @ _rotation(inputs["quats"][order])
    axes = turned * inputs["scales"][order, None, :]
    covariance = axes @ axes.transpose(1, 2) + limits.dilation * torch.eye(2, dtype=z.dtype)
    centre = -view[:3, :3].T @ view[:3, 3]
    direction = torch.nn.functional.normalize(inputs["means"][order] - centre, dim=1)
    colour = _colour(inputs["colors"][order], direction, scene.sh_degree)
    return means2d, torch.linalg.inv(covariance), inputs["opacities"][order], colour, z


def _clamped(slope: Tensor, length: int, focal: float, centre: float) -> Tensor:
    """Returns slopes no further outside the picture than the margin: the projection is not linear there."""
    margin = FRUSTUM_MARGIN * length / (2 * focal)
    return slope.clamp(-centre / focal - margin, (length - centre) / focal + margin)


def _rotation(quats: Tensor) -> Tensor:
    w, v = quats[:, :1], quats[:, 1:]
    squared = (quats * quats).sum(dim=1, keepdim=True)
    columns = []
    for k in range(3):
        e = torch.zeros_like(v)
        e[:, k] = 1
        # q e q*, with the cross products written out once
        inner = torch.linalg.cross(v, e, dim=1)
        columns.append(e + 2 * (w * inner + torch.linalg.cross(v, inner, dim=1)) / squared)
    return torch.stack(columns, dim=2)


def _colour(bands: Tensor, direction: Tensor, degree: int) -> Tensor:
    x, y, z = direction.unbind(1)
    shapes = [
        [torch.ones_like(x)],
        [y, z, x],
        [x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y],
        [y * (3 * x * x - y * y), x * y * z, y * (5 * z * z - 1), z * (5 * z * z - 3), x * (5 * z * z - 1),
         z * (x * x - y * y), x * (x * x - 3 * y * y)],
    ]  # fmt: skip
    basis = [n * s for d in range(degree + 1) for n, s in zip(_BANDS[d], shapes[d], strict=True)]
    return (0.5 + torch.einsum("nk,nkc->nc", torch.stack(basis, 1), bands[:, : len(basis)])).clamp(min=0)


def _rows_reached(splats: list[Tensor], limits: Limits) -> tuple[Tensor, Tensor]:
    """Returns the first and last row, in pixels, where a Gaussian's alpha can reach the floor."""
    means2d, inverse, opacity = splats[:3]
    determinant = torch.linalg.det(inverse)
    variance = inverse[:, 0, 0] / determinant
    half = (2 * variance * torch.log((opacity / limits.alpha_min).clamp(min=1))).sqrt()
    return means2d[:, 1] - half - 1, means2d[:, 1] + half + 1


def _blend(splats: list[Tensor], row: int, rows: int, width: int, limits: Limits) -> list[Tensor]:
    """Returns colour, alpha and expected depth of some rows, `[rows, width, C]`."""
    means2d, inverse, opacity, colour, depth = splats
    ys = torch.arange(row, row + rows, dtype=torch.float64) + 0.5
    xs = torch.arange(width, dtype=torch.float64) + 0.5
    d = torch.stack([xs.repeat(rows), ys.repeat_interleave(width)], dim=1)[:, None, :] - means2d[None]
    power = torch.einsum("pni,nij,pnj->pn", d, inverse, d) / 2
    alpha = opacity * torch.exp(-power)
    alpha = torch.where(alpha < limits.alpha_min, torch.zeros_like(alpha), alpha.clamp(max=limits.alpha_max))
    through = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)
    # the splat that crosses the limit still counts, the ones behind it do not
    weight = torch.where(before < limits.stop, torch.zeros_like(alpha), alpha * before)
    total = weight.sum(dim=1)
    seen = total > 0
    mean_depth = torch.where(seen, weight @ depth / torch.where(seen, total, 1.0), 0.0)
    return [p.view(rows, width, -1) for p in (weight @ colour, total, mean_depth)]
