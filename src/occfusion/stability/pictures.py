"""Axes of the rasteriser, against the dense renderer of the benchmark."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch

from occfusion.bench.contestants import available_backends, backend
from occfusion.bench.reference import dense_reference
from occfusion.bench.scenes import BenchScene
from occfusion.splat.harmonics import num_coefficients
from occfusion.stability.axes import Answer, Axis, Bound, Method
from occfusion.types import Camera

Scenes = Callable[[float], BenchScene]
"""Makes the scene of a place on an axis."""
SINGLE, DOUBLE = Bound(1e-4, 1e-3), Bound(1e-9, 1e-7)
"""A threshold that is crossed in one precision and not in the other moves a pixel by 1/255 of a splat."""
SIDE, DISTANCE = 48, 2.0
"""Of the picture, pixels, which is its focal length too; of the Gaussians, metres."""


def picture_axes(device: torch.device) -> list[Axis]:
    """Returns the axes of the rasteriser, for every backend that runs on a device."""
    tens = (1, 10, 1e2, 1e3, 1e4, 1e5, 1e6)
    sizes = (0.01, 0.1, 0.3, 1, 3, 10, 100, 1000)
    depths = (1e-2, 0.1, 1, 10, 1e2, 1e3, 1e4, 1e5)
    opacities = (0.005, 0.1, 0.5, 0.9, 0.99, 0.999, 1)
    counts = (0, 1, 10, 100, 1e3, 1e4, 1e5, 2e5)

    axis = partial(_axis, device)
    return [
        axis("anisotropy, longest to thinnest", tens, (1, 1e3, 1e6), _needles),
        axis("screen size, px", sizes, (0.01, 1, 1000), _sizes),
        axis("depth, farthest to nearest", depths, (1e-2, 1, 1e5), _depths),
        axis("opacity", opacities, (0.005, 0.99, 1), _opacities),
        axis("layers of opacity 0.99", (1, 3, 10, 100, 1000), (1, 100), lambda n: _layers(int(n), 0.99)),
        axis("layers of opacity 0.02", (1, 10, 100, 1000, 10_000), (1, 100), lambda n: _layers(int(n), 0.02)),
        axis("Gaussians", counts, (0, 1, 1e3), _many),
        axis("picture, px", (1, 7, 33, 128, 512, 2048), (1, 33), lambda side: scatter(12, int(side))),
    ]


def _axis(
    device: torch.device, name: str, places: Sequence[float], quick: Sequence[float], make: Scenes
) -> Axis:
    def method(backend_name: str, dtype: torch.dtype, bound: Bound) -> Method:
        contestant = backend(backend_name, dtype)

        def answer(place: float) -> Answer:
            (rgb, alpha, _), gradients = contestant.gradients(make(place).to(device))
            return {"rgb": rgb, "alpha": alpha}, gradients

        return Method(f"{backend_name} {str(dtype).removeprefix('torch.')}", answer, bound)

    def oracle(place: float) -> Answer:
        scene = make(place)
        if not len(scene.inputs["means"]):  # nothing is drawn, and nothing has a gradient
            side = scene.camera.width
            return {"rgb": torch.zeros(side, side, 3), "alpha": torch.zeros(side, side)}, {}
        found = dense_reference(scene)
        return {"rgb": found.rgb, "alpha": found.alpha}, found.gradients

    methods = [method(known, torch.float32, SINGLE) for known in available_backends(device)]
    methods.append(method("torch", torch.float64, DOUBLE))
    return Axis(name, places, quick, methods, oracle)


def scatter(count: int, side: int = SIDE, seed: int = 0) -> BenchScene:
    """Returns Gaussians about the origin, of a few pixels each, before a camera that looks at it."""
    generator = torch.Generator().manual_seed(seed)
    scale = DISTANCE / side  # of a pixel, metres
    means = (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([1.4, 1.4, 0.4])
    bands = 0.1 * torch.randn(count, num_coefficients(1), 3, generator=generator)
    bands[:, 0] = torch.rand(count, 3, generator=generator) * 3 - 1.5
    inputs = {
        "means": means,
        "quats": torch.randn(count, 4, generator=generator),
        "scales": scale * max(side / 16, 1.0) * torch.exp(0.4 * torch.randn(count, 3, generator=generator)),
        "opacities": torch.full((count,), 0.6),
        "colors": bands,
    }
    viewmat = torch.eye(4)
    viewmat[2, 3] = DISTANCE
    K = torch.tensor([[side, 0.0, side / 2], [0.0, side, side / 2], [0.0, 0.0, 1.0]])
    rgb, alpha = (torch.randn(shape, generator=generator) for shape in ((side, side, 3), (side, side)))
    # expected depth divides by alpha: where only a faint splat is seen it jumps with any cut-off
    return BenchScene(inputs, Camera(viewmat, K, side, side), 1, (rgb, alpha, torch.zeros(side, side)))


def _changed(scene: BenchScene, **inputs: torch.Tensor) -> BenchScene:
    return replace(scene, inputs={**scene.inputs, **inputs})


def _needles(ratio: float) -> BenchScene:
    scene = scatter(20)
    length = 20 * DISTANCE / SIDE
    return _changed(
        scene, scales=torch.tensor([length, length / ratio, length / ratio]).expand(20, 3).clone()
    )


def _sizes(pixels: float) -> BenchScene:
    scene = scatter(20)
    return _changed(scene, scales=scene.inputs["scales"] * (pixels / 3.0))


def _depths(ratio: float) -> BenchScene:
    """Every other Gaussian is at `ratio` times the distance, and as large in the picture as before."""
    scene = scatter(20)
    factor = torch.ones(20, 1)
    factor[::2] = ratio
    eye = torch.tensor([0.0, 0.0, -DISTANCE])
    means = eye + (scene.inputs["means"] - eye) * factor
    return _changed(scene, means=means, scales=scene.inputs["scales"] * factor)


def _opacities(opacity: float) -> BenchScene:
    return _changed(scatter(20), opacities=torch.full((20,), opacity))


def _layers(count: int, opacity: float) -> BenchScene:
    scene = scatter(count, side=16)
    means = scene.inputs["means"] * torch.tensor([0.05, 0.05, 1.0])
    return _changed(scene, means=means, opacities=torch.full((count,), opacity))


def _many(count: float) -> BenchScene:
    scene = scatter(int(count))
    # as many times smaller as there are more: about as many in each pixel
    return _changed(scene, scales=scene.inputs["scales"] / math.sqrt(max(count / 100, 1.0)))
