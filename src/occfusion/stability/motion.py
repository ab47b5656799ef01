"""Axes of everything but pictures: rotations, limbs, diffusion, time, weights of a loss; and how Adam walks."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.geometry.skinning import blend, bone_transforms, skin_covariances, skin_points
from occfusion.human.pose_spline import PoseSpline
from occfusion.priors.embedded.diffusion import clean_and_noise, diffuse, velocity
from occfusion.quality import losses
from occfusion.stability.axes import TYPES, Answer, Axis, Bound, Method

SINGLE, DOUBLE = Bound(1e-5, 1e-5), Bound(1e-12, 1e-10)


def motion_axes() -> list[Axis]:
    """Returns the axes of the pure functions."""
    half, turn = math.pi, 2 * math.pi
    angles = (0, 1e-30, 1e-12, 1e-6, 1e-3, 0.0999, 0.1001, 1, half - 1e-6, half, turn - 1e-6, turn, 100)
    limbs = (0, 1, 45, 90, 135, 170, 179, 179.9, 180)
    times = (0, 1e-6, 1e-3, 0.02, 0.5, 0.98, 0.999, 1 - 1e-6, 1)
    counts = (1, 2, 3, 10, 100, 1000, 2000)
    ratios, scales = (1, 10, 1e3, 1e4, 2e5, 1e8), (1e-8, 1e-4, 1, 1e4, 1e8)
    # where gradients are 1e-8, the 1e-15 that keeps Adam from dividing by 0 is seen in double precision
    near = Bound(1e-9, 0)
    return [
        _axis("rotation angle, rad", angles, (0, 1e-12, half, turn), _rotation, _rotation_oracle, SINGLE),
        _axis("opposed weights, degrees", limbs, (0, 90, 180), _limb, _limb_oracle, SINGLE),
        _axis("diffusion time", times, (0, 0.5, 1), _diffusion, _diffusion_oracle, SINGLE, Bound(3e-2, 3e-2)),
        _axis("frames", counts, (1, 2, 100), _frames, _frames_oracle, SINGLE),
        _axis("ratio of loss weights", ratios, (1, 2e5), _weighted, _weighted_oracle, SINGLE),
        _axis("scale of all weights", scales, (1e-4, 1, 1e4), _scaled, _scaled_oracle, SINGLE, double=near),
    ]


def _axis(
    name: str,
    places: tuple[float, ...],
    quick: tuple[float, ...],
    function: Callable[[float, torch.dtype], Answer],
    oracle: Callable[[float], Answer],
    single: Bound,
    half: Bound | None = None,
    double: Bound = DOUBLE,
) -> Axis:
    bounds = {"float32": single, "float64": double} | ({} if half is None else {"bfloat16": half})
    methods = [
        Method(kind, lambda place, dtype=TYPES[kind]: function(place, dtype), bound)  # type: ignore[misc]
        for kind, bound in bounds.items()
    ]
    return Axis(name, places, quick, methods, oracle)


def _numbers(*shape: int, seed: int = 0) -> Tensor:
    """Returns standard normal numbers that float32 holds exactly."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def _gradients(value: Tensor, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    weights = _numbers(*value.shape, seed=9).to(value)
    found = torch.autograd.grad((value * weights).sum(), list(inputs.values()))
    return dict(zip(inputs, found, strict=True))


# --- rotations -------------------------------------------------------------------------------------------------


def _vector(angle: float, dtype: torch.dtype) -> Tensor:
    axis = torch.tensor([0.36, -0.48, 0.8], dtype=torch.float64)
    # the oracle is given what single precision is given
    return (axis * angle).float().to(dtype).requires_grad_()


def _rotation(angle: float, dtype: torch.dtype) -> Answer:
    vector = _vector(angle, dtype)
    matrix = axis_angle_to_matrix(vector)
    return {"matrix": matrix}, _gradients(matrix, {"vector": vector})


def _rotation_oracle(angle: float) -> Answer:
    vector = _vector(angle, torch.float64)
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    matrix = torch.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3))
    return {"matrix": matrix}, _gradients(matrix, {"vector": vector})


# --- limbs -----------------------------------------------------------------------------------------------------


def _limb_inputs(degrees: float, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Returns turns of two bones, joints, weights that share points between them, points and covariances."""
    angle = math.radians(degrees)
    turn = torch.tensor(
        [[1.0, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]],
        dtype=torch.float64,
    )
    root = _numbers(5, 3, 3, seed=2)
    weights = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)
    return (
        torch.stack([torch.eye(3, dtype=torch.float64), turn.float().double()]).to(dtype),
        torch.tensor([[0.0, 0, 0], [0.3, 0, 0]]).to(dtype),
        torch.stack([weights, 1 - weights], dim=1).to(dtype),
        _numbers(5, 3, seed=1).to(dtype).requires_grad_(),
        (0.01 * root @ root.transpose(1, 2)).float().to(dtype).requires_grad_(),
    )


def _limb(degrees: float, dtype: torch.dtype) -> Answer:
    turns, joints, weights, points, covariances = _limb_inputs(degrees, dtype)
    maps = blend(weights, bone_transforms(turns, joints, (-1, 0)))
    moved, turned = skin_points(points, maps), skin_covariances(covariances, maps)
    both = torch.cat([moved, turned.flatten(1)], dim=1)
    return {"points": moved, "covariances": turned}, _gradients(
        both, {"points": points, "covariances": covariances}
    )


def _limb_oracle(degrees: float) -> Answer:
    """Point by point: each bone moves it, and the results are mixed."""
    turns, joints, weights, points, covariances = _limb_inputs(degrees, torch.float64)
    moved, turned = [], []
    for k in range(len(points)):
        first, second = points[k], joints[1] + turns[1] @ (points[k] - joints[1])
        moved.append(weights[k, 0] * first + weights[k, 1] * second)
        mixed = weights[k, 0] * torch.eye(3).double() + weights[k, 1] * turns[1]
        turned.append(torch.einsum("ij,jk,lk->il", mixed, covariances[k], mixed))
    both = torch.cat([torch.stack(moved), torch.stack(turned).flatten(1)], dim=1)
    values = {"points": torch.stack(moved), "covariances": torch.stack(turned)}
    return values, _gradients(both, {"points": points, "covariances": covariances})


# --- diffusion -------------------------------------------------------------------------------------------------


def _diffusion(time: float, dtype: torch.dtype) -> Answer:
    clean, noise, t = (
        part.to(dtype) for part in (_numbers(2, 64), _numbers(2, 64, seed=1), torch.full((2,), time))
    )
    noisy, v = diffuse(clean, noise, t), velocity(clean, noise, t).requires_grad_()
    found_clean, found_noise = clean_and_noise(noisy, v, t)
    gradients = _gradients(torch.cat([found_clean, found_noise]), {"v": v})
    return {"clean": found_clean, "noise": found_noise}, gradients


def _diffusion_oracle(time: float) -> Answer:
    """What was mixed comes back; v has -sin in the clean signal, and cos in the noise."""
    angle = 0.5 * math.pi * float(torch.tensor(time))
    weights = _numbers(4, 64, seed=9)
    gradient = -math.sin(angle) * weights[:2] + math.cos(angle) * weights[2:]
    return {"clean": _numbers(2, 64), "noise": _numbers(2, 64, seed=1)}, {"v": gradient}


# --- time ------------------------------------------------------------------------------------------------------


def _frames(count: float, dtype: torch.dtype) -> Answer:
    spline = PoseSpline.over(range(int(count)), 4).to(dtype)
    with torch.no_grad():
        spline.turns.copy_(_numbers(*spline.turns.shape))
    values = torch.stack([spline.at(frame)[0] for frame in _looked_at(int(count))])
    return {"turns": values}, _gradients(values, {"turns": spline.turns})


def _looked_at(count: int) -> list[int]:
    return sorted({round(k * (count - 1) / 12) for k in range(13)})


def _frames_oracle(count: float) -> Answer:
    """De Boor's recursion on uniform knots."""
    pieces = max(math.ceil((count - 1) / 4), 1)
    spacing = (count - 1) / pieces or 1.0
    knots = _numbers(pieces + 3, 24, 3).requires_grad_()
    values = []
    for frame in _looked_at(int(count)):
        place = frame / spacing
        piece = min(int(place + 1e-12), pieces - 1)
        points = [knots[piece + k] for k in range(4)]
        for level in range(1, 4):
            for k in range(3, level - 1, -1):
                share = (place - (piece + k - 3)) / (4 - level)
                points[k] = (1 - share) * points[k - 1] + share * points[k]
        values.append(points[3])
    return {"turns": torch.stack(values)}, _gradients(torch.stack(values), {"turns": knots})


# --- weights of a loss -----------------------------------------------------------------------------------------


def _weighted(ratio: float, dtype: torch.dtype) -> Answer:
    a, b = _numbers(16, 16, 3).to(dtype).requires_grad_(), _numbers(16, 16, 3, seed=1).to(dtype)
    total = ratio * losses.l1(a, b) + losses.l2(a, b)
    return {"total": total}, {"a": torch.autograd.grad(total, a)[0]}


def _weighted_oracle(ratio: float) -> Answer:
    difference = (_numbers(16, 16, 3) - _numbers(16, 16, 3, seed=1)).numpy()
    total = ratio * abs(difference).sum() / difference.size + (difference**2).sum() / difference.size
    gradient = (ratio * ((difference > 0) * 1.0 - (difference < 0)) + 2 * difference) / difference.size
    return {"total": torch.tensor(total)}, {"a": torch.from_numpy(gradient)}


def _scaled(scale: float, dtype: torch.dtype) -> Answer:
    """Where Adam, as the stages use it, is after 60 steps down a valley, its loss times `scale`."""
    place = torch.tensor([1.0, -2.0], dtype=dtype, requires_grad=True)
    adam = torch.optim.Adam([place], lr=1e-2, eps=1e-15)
    for _ in range(60):
        adam.zero_grad()
        (scale * (place[0] ** 2 + 100.0 * (place[1] - place[0]) ** 2)).backward()
        adam.step()
    return {"place": place}, {}


def _scaled_oracle(_: float) -> Answer:
    """Adam's recursion, written out, of the loss times 1: a factor on all weights changes nothing."""
    x, first, second = [1.0, -2.0], [0.0, 0.0], [0.0, 0.0]
    for step in range(1, 61):
        across = 200.0 * (x[1] - x[0])
        gradient = [2.0 * x[0] - across, across]
        for k in range(2):
            first[k] += 0.1 * (gradient[k] - first[k])
            second[k] += 0.001 * (gradient[k] ** 2 - second[k])
        steps = [
            f / (1 - 0.9**step) / math.sqrt(s / (1 - 0.999**step)) for f, s in zip(first, second, strict=True)
        ]
        x = [a - 1e-2 * b for a, b in zip(x, steps, strict=True)]
    return {"place": torch.tensor(x, dtype=torch.float64)}, {}
