"""Dense float64 splatting written from the formulas: every pixel blends all Gaussians.

Shares nothing with the package: explicit inverse of the 2x2 covariance, no tiles, no early exit.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

ALPHA_MAX, ALPHA_MIN, STOP, DILATION = 0.999, 1 / 255, 1e-4, 0.3


def rotation(q: Tensor) -> Tensor:
    """Rotates basis vectors by q v q*, the definition of a quaternion rotation."""
    q = q / q.norm()
    w, v = q[0], q[1:]
    columns = [
        e + 2 * w * torch.linalg.cross(v, e) + 2 * torch.linalg.cross(v, torch.linalg.cross(v, e))
        for e in torch.eye(3, dtype=q.dtype)
    ]
    return torch.stack(columns, dim=1)


def harmonics_color(sh: Tensor, direction: Tensor, degree: int) -> Tensor:
    """0.5 + sum of c_lm Y_lm from associated Legendre polynomials, clamped at zero."""
    x, y, z = direction.unbind(-1)
    total = torch.full_like(sh[0], 0.5)
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            norm = math.sqrt(
                (2 * l + 1) / (4 * math.pi) * math.factorial(l - abs(m)) / math.factorial(l + abs(m))
            )
            # P_l^m / sin^m as a polynomial in z (with Condon-Shortley phase), times Re/Im (x + iy)^m
            legendre = _legendre_over_sine(l, abs(m), z)
            real, imag = torch.ones_like(x), torch.zeros_like(x)
            for _ in range(abs(m)):
                real, imag = real * x - imag * y, real * y + imag * x
            angular = 1.0 if m == 0 else math.sqrt(2) * (real if m > 0 else imag)
            total = total + sh[l * l + l + m] * norm * legendre * angular
    return total.clamp(min=0)


def _legendre_over_sine(l: int, m: int, z: Tensor) -> Tensor:
    p_mm = torch.ones_like(z) * (-1) ** m * math.prod(range(1, 2 * m, 2))
    if l == m:
        return p_mm
    previous, current = p_mm, z * (2 * m + 1) * p_mm
    for k in range(m + 2, l + 1):
        previous, current = current, ((2 * k - 1) * z * current - (k + m - 1) * previous) / (k - m)
    return current


def render(means, quats, scales, opacities, colors, viewmat, K, width, height, background=None, sh_degree=None,
           covariances=None, screen_offsets=None, antialiased=False, near=0.01, dilation=DILATION):  # fmt: skip
    """(rgb, alpha, depth) with autograd through every line."""
    flat = project(means, quats, scales, opacities, colors, viewmat, K, width, height, sh_degree, covariances,
                   screen_offsets, antialiased, near, dilation)  # fmt: skip
    return blend(*flat, width, (0, height), background)


def project(means, quats, scales, opacities, colors, viewmat, K, width, height, sh_degree=None, covariances=None,
            screen_offsets=None, antialiased=False, near=0.01, dilation=DILATION):  # fmt: skip
    """Centres [M, 2], conics [M, 2, 2], opacities, colours [M, 3] and depths of what is in front, nearest first."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    lim = {
        "left": cx / fx + 0.15 * width / fx, "right": (width - cx) / fx + 0.15 * width / fx,
        "top": cy / fy + 0.15 * height / fy, "bottom": (height - cy) / fy + 0.15 * height / fy,
    }  # fmt: skip
    distances = (means.detach() @ R[2].detach() + t[2].detach()).tolist()
    front = sorted((i for i in range(len(means)) if distances[i] > near), key=lambda i: (distances[i], i))
    rows = []
    for i in front:
        p = R @ means[i] + t
        x, y, z = p.unbind()
        slope_x = torch.clamp(x / z, -lim["left"], lim["right"])
        slope_y = torch.clamp(y / z, -lim["top"], lim["bottom"])
        zero = torch.zeros_like(z)
        J = torch.stack(
            [torch.stack([fx / z, zero, -fx * slope_x / z]), torch.stack([zero, fy / z, -fy * slope_y / z])]
        )
        if covariances is not None:
            sigma = covariances[i]
        else:
            root = rotation(quats[i]) @ torch.diag(scales[i])
            sigma = root @ root.T
        flat = J @ R @ sigma @ R.T @ J.T
        plane = flat + dilation * torch.eye(2, dtype=means.dtype)
        opacity = opacities[i]
        if antialiased:
            opacity = opacity * torch.sqrt(torch.linalg.det(flat) / torch.linalg.det(plane))
        centre = torch.stack([fx * x / z + cx, fy * y / z + cy])
        if screen_offsets is not None:
            centre = centre + screen_offsets[i]
        color = colors[i]
        if sh_degree is not None:
            ray = means[i] + R.T @ t
            color = harmonics_color(colors[i], ray / ray.norm(), sh_degree)
        rows.append((centre, torch.linalg.inv(plane), opacity, color, z))
    if not rows:
        shapes = [(0, 2), (0, 2, 2), (0,), (0, 3), (0,)]
        return tuple(torch.zeros(shape, dtype=means.dtype) for shape in shapes)
    return tuple(torch.stack(column) for column in zip(*rows, strict=True))


def blend(centres, conics, opacities, colors, depths, width, rows, background=None):
    """(rgb, alpha, depth) of the picture's rows (first, end): every pixel, every splat, nearest first."""
    top, end = rows
    ys, xs = torch.meshgrid(
        torch.arange(top, end, dtype=centres.dtype) + 0.5, torch.arange(width, dtype=centres.dtype) + 0.5,
        indexing="ij",
    )  # fmt: skip
    rgb = torch.zeros(end - top, width, 3, dtype=centres.dtype)
    depth_sum = torch.zeros(end - top, width, dtype=centres.dtype)
    transmittance = torch.ones(end - top, width, dtype=centres.dtype)
    running = torch.ones(end - top, width, dtype=torch.bool)
    for centre, conic, opacity, color, z in zip(centres, conics, opacities, colors, depths, strict=True):
        d = torch.stack([xs - centre[0], ys - centre[1]], dim=-1)
        power = -0.5 * (d @ conic * d).sum(-1)
        alpha = opacity * torch.exp(power)
        alpha = torch.where(alpha > ALPHA_MAX, torch.full_like(alpha, ALPHA_MAX), alpha)
        alpha = torch.where((alpha >= ALPHA_MIN) & running, alpha, torch.zeros_like(alpha))
        weight = transmittance * alpha
        rgb = rgb + weight[..., None] * color
        depth_sum = depth_sum + weight * z
        transmittance = transmittance * (1 - alpha)
        running = running & (transmittance.detach() >= STOP)
    alpha = 1 - transmittance
    if background is not None:
        rgb = rgb + transmittance[..., None] * background
    depth = torch.where(alpha > 0, depth_sum / torch.where(alpha > 0, alpha, torch.ones_like(alpha)), 0.0)
    return rgb, alpha, depth
