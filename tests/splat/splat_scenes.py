"""Seeded scenes for the tests of the rasteriser, and how two results are compared."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from occfusion.splat import rasterize

LAYERS = ("rgb", "alpha", "depth")


@dataclass
class Scene:
    """Arguments of `rasterize`: the tensors that take gradients, and the rest."""

    tensors: dict[str, Tensor]
    K: Tensor
    width: int
    height: int
    options: dict[str, Any] = field(default_factory=dict)

    def to(self, dtype: torch.dtype) -> Scene:
        tensors = {name: t.detach().to(dtype).requires_grad_() for name, t in self.tensors.items()}
        return Scene(tensors, self.K.to(dtype), self.width, self.height, dict(self.options))

    def arguments(self) -> dict[str, Any]:
        given = {"quats": None, "scales": None, **self.tensors, **self.options}
        return {**given, "K": self.K, "width": self.width, "height": self.height}

    def render(self, backend: str, **options: Any) -> Any:
        return rasterize(**{**self.arguments(), **options}, backend=backend)

    def take(self, index: Any) -> Scene:
        shared = ("viewmat", "background")
        tensors = {n: t if n in shared else t[index] for n, t in self.tensors.items()}
        return Scene(tensors, self.K, self.width, self.height, self.options)


def make_scene(
    n: int = 60, width: int = 40, height: int = 30, degree: int | None = 3, seed: int = 0, size: float = 0.1,
    spread: float = 0.5, covariances: bool = False, background: bool = True, dtype: torch.dtype = torch.float64,
    antialiased: bool = False,
) -> Scene:  # fmt: skip
    """Gaussians around the origin, some off the picture and some behind the camera, 2 m away and askew."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    twist = normal(3, 3) * 0.2
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.linalg.matrix_exp(twist - twist.T)
    viewmat[:3, 3] = torch.tensor([0.1, -0.05, 2.0])
    scales = size * torch.exp(0.7 * normal(n, 3))
    quats = normal(n, 4)
    tensors = {
        "means": spread * normal(n, 3),
        "opacities": torch.rand(n, generator=generator, dtype=torch.float64) * 0.98 + 0.01,
        "colors": torch.rand(n, 3, generator=generator, dtype=torch.float64)
        if degree is None
        else 0.3 * normal(n, 16, 3),
        "viewmat": viewmat,
        "screen_offsets": torch.zeros(n, 2, dtype=torch.float64),
    }
    if covariances:
        root = torch.linalg.qr(normal(n, 3, 3)).Q * scales[:, None, :] if n else torch.zeros(0, 3, 3).double()
        tensors["covariances"] = root @ root.transpose(1, 2)
    else:
        tensors |= {"quats": quats, "scales": scales}
    if background:
        tensors["background"] = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    K = torch.tensor(
        [[width * 1.1, 0, width * 0.45], [0, width * 1.2, height * 0.53], [0, 0, 1]], dtype=torch.float64
    )
    return Scene(tensors, K, width, height, {"sh_degree": degree, "antialiased": antialiased}).to(dtype)


def picture_weights(scene: Scene, seed: int = 1) -> dict[str, Tensor]:
    """Random gradients of the three layers."""
    generator = torch.Generator().manual_seed(seed)
    shapes = {"rgb": (scene.height, scene.width, 3), "alpha": (scene.height, scene.width)}
    shapes["depth"] = shapes["alpha"]
    return {n: torch.randn(*s, generator=generator, dtype=torch.float64) for n, s in shapes.items()}


def gradients(scene: Scene, layers: dict[str, Tensor], weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Gradients of the weighted sum of the layers by every tensor of the scene."""
    total = sum((layers[n] * weights[n].to(layers[n].dtype)).sum() for n in layers)
    found = torch.autograd.grad(total, list(scene.tensors.values()), allow_unused=True)
    zero = {n: torch.zeros_like(t) for n, t in scene.tensors.items()}
    return {n: g if g is not None else zero[n] for n, g in zip(scene.tensors, found, strict=True)}


def results(scene: Scene, backend: str, **options: Any) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Layers and gradients of a backend."""
    rendering = scene.render(backend, **options)
    layers = {n: getattr(rendering, n) for n in LAYERS}
    return layers, gradients(scene, layers, picture_weights(scene))


def assert_same(
    actual: Tensor, expected: Tensor, tolerance: float, name: str = "", floor: float = 1e-6
) -> None:
    """Finite first; then relative L2, direction, and the magnitude of every row.

    A row whose gradient is silently zero or doubled hides in a norm; rows below `floor` of the
    largest are noise and not judged.
    """
    assert actual.shape == expected.shape, name
    assert bool(actual.isfinite().all()), f"{name} is not finite"
    a, e = actual.detach().double(), expected.detach().double()
    scale = float(e.norm())
    if scale == 0:
        assert float(a.abs().max()) == 0 if a.numel() else True, f"{name} should be zero"
        return
    assert float((a - e).norm()) <= tolerance * scale, (
        f"{name}: relative error {float((a - e).norm()) / scale:.2e}"
    )
    assert float((a * e).sum()) >= (1 - tolerance) * float(a.norm()) * scale, f"{name}: direction"
    if a.ndim > 1:
        rows_a, rows_e = a.flatten(1).norm(dim=1), e.flatten(1).norm(dim=1)
        judged = rows_e > floor * rows_e.max()
        ratio = rows_a[judged] / rows_e[judged]
        slack = tolerance + 10 * tolerance * rows_e.max() / rows_e[judged]
        assert bool(((ratio - 1).abs() <= slack).all()), (
            f"{name}: a row is {float(ratio.min()):.3f} to {float(ratio.max()):.3f} of what it should be"
        )


def assert_all_same(actual: tuple[dict, dict], expected: tuple[dict, dict], tolerance: float) -> None:
    for kind, got, wanted in zip(("layer", "gradient of"), actual, expected, strict=True):
        for name, value in wanted.items():
            assert_same(got[name], value, tolerance, f"{kind} {name}")
