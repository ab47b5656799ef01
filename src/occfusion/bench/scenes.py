"""Seeded scenes for measuring: Gaussians on the surface of the embedded body, seen by one camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from occfusion.geometry.camera import orbit_camera
from occfusion.human import embedded_body
from occfusion.splat.harmonics import num_coefficients
from occfusion.types import Camera

PERSON_SHARE = 0.6
"""Height of the person over that of the picture."""
FIELD_OF_VIEW = math.radians(45)
ARMS_DOWN = 1.1
"""Radians by which the shoulders are turned: a person of the usual width, not a cross."""
NEIGHBOUR_SPACING = 0.729
"""Mean distance to the three nearest of points scattered evenly at density d is 0.729 / sqrt(d)."""
ANISOTROPY = 0.4
"""Spread of the logarithms of a Gaussian's three sizes."""
BAND_STRENGTH = 0.1
"""Spread of the SH coefficients above the constant one."""


@dataclass(frozen=True)
class SceneSize:
    """What a scene is measured over.

    Attributes:
        gaussians: how many.
        size: side of the square picture, pixels.
        footprint: factor on the Gaussians' sizes.
        sh_degree: degree of the harmonics that are stored and used.
    """

    gaussians: int
    size: int
    footprint: float = 1.0
    sh_degree: int = 3


@dataclass(frozen=True)
class BenchScene:
    """The inputs of `rasterize`, and fixed weights that turn its outputs into a scalar.

    Attributes:
        inputs: means, quats, scales, opacities and harmonics coefficients, by name.
        camera: the camera.
        sh_degree: bands to use.
        cotangents: weights of rgb `[H, W, 3]`, alpha `[H, W]` and depth `[H, W]` in the scalar.
    """

    inputs: dict[str, Tensor]
    camera: Camera
    sh_degree: int
    cotangents: tuple[Tensor, Tensor, Tensor]

    def leaves(self, dtype: torch.dtype | None = None) -> dict[str, Tensor]:
        """Returns the inputs as leaves that collect gradients anew; the memory is shared where the type is kept."""
        return {k: v.detach().to(dtype or v.dtype).requires_grad_() for k, v in self.inputs.items()}

    def arguments(self, inputs: dict[str, Tensor]) -> dict[str, Any]:
        """Returns the keyword arguments of `rasterize` for some inputs, the camera in their type."""
        like, camera = inputs["means"], self.camera
        return {
            **inputs,
            "viewmat": camera.viewmat.to(like),
            "K": camera.K.to(like),
            "width": camera.width,
            "height": camera.height,
            "sh_degree": self.sh_degree,
        }

    def without_depth(self) -> BenchScene:
        """Returns the scene with a scalar that leaves depth out.

        Expected depth divides by alpha: where only a faint splat is seen it jumps with any cut-off.
        """
        rgb, alpha, depth = self.cotangents
        return replace(self, cotangents=(rgb, alpha, torch.zeros_like(depth)))

    def to(self, device: torch.device) -> BenchScene:
        """Returns the scene on a device."""
        return replace(
            self,
            inputs={k: v.to(device) for k, v in self.inputs.items()},
            camera=self.camera.to(device),
            cotangents=tuple(w.to(device) for w in self.cotangents),  # type: ignore[arg-type]
        )


def make_scene(size: SceneSize, seed: int = 0) -> BenchScene:
    """Returns a scene: the same for the same size and seed, on any machine with the same torch."""
    generator = torch.Generator().manual_seed(seed)
    means, area = _surface_points(size.gaussians, generator)
    n = size.gaussians
    spacing = NEIGHBOUR_SPACING * math.sqrt(area / max(n, 1))
    bands = torch.randn(n, num_coefficients(size.sh_degree), 3, generator=generator) * BAND_STRENGTH
    bands[:, 0] = torch.rand(n, 3, generator=generator) * 3 - 1.5
    spread = torch.exp(ANISOTROPY * torch.randn(n, 3, generator=generator))
    inputs = {
        "means": means,
        "quats": torch.randn(n, 4, generator=generator),
        "scales": spacing * size.footprint * spread,
        "opacities": torch.full((n,), 0.9),
        "colors": bands,
    }
    side = size.size
    weights = [
        torch.randn(shape, generator=generator) for shape in ((side, side, 3), (side, side), (side, side))
    ]
    return BenchScene(inputs, _camera(side), size.sh_degree, (weights[0], weights[1], weights[2]))


def _posed_vertices() -> tuple[Tensor, Tensor]:
    body = embedded_body()
    pose = torch.zeros(23, 3)
    pose[15, 2], pose[16, 2] = -ARMS_DOWN, ARMS_DOWN
    vertices, _ = body(torch.zeros(0), torch.zeros(3), pose.flatten(), torch.zeros(3))
    return vertices, body.faces.long()


def _surface_points(count: int, generator: torch.Generator) -> tuple[Tensor, float]:
    """Returns points scattered evenly over the body, `[count, 3]`, and its area in square metres."""
    vertices, faces = _posed_vertices()
    corners = vertices[faces]
    areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1) / 2
    places = torch.rand(count, generator=generator, dtype=torch.float64)
    chosen = torch.searchsorted(areas.double().cumsum(0) / areas.double().sum(), places).clamp(
        max=len(faces) - 1
    )
    u, v = torch.rand(2, count, 1, generator=generator)
    root = u.sqrt()
    a, b, c = corners[chosen].unbind(1)
    return (1 - root) * a + root * (1 - v) * b + root * v * c, float(areas.sum())


def _camera(side: int) -> Camera:
    vertices, _ = _posed_vertices()
    low, high = vertices.amin(dim=0), vertices.amax(dim=0)
    distance = float(high[1] - low[1]) / (2 * math.tan(FIELD_OF_VIEW / 2) * PERSON_SHARE)
    return orbit_camera((low + high) / 2, 0.4, distance, FIELD_OF_VIEW, side)
