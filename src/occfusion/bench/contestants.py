"""What is measured: the backends that can run here, and other packages that happen to be importable."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from occfusion.bench.scenes import BenchScene
from occfusion.errors import ConfigError
from occfusion.splat import Limits, rasterize, resolve_backend
from occfusion.splat.backends import torch_backend
from occfusion.splat.backends.registry import BACKENDS
from occfusion.splat.limits import DEFAULT_LIMITS
from occfusion.splat.request import Request, read_intrinsics

Pictures = tuple[Tensor, Tensor, Tensor | None]
"""rgb `[H, W, 3]`, alpha `[H, W]`, and depth `[H, W]` where the renderer has one."""


@dataclass(frozen=True)
class Contestant:
    """A renderer under one name.

    Attributes:
        name: as in tables.
        render: gives the pictures of a scene from the given inputs.
        dtype: the type that its inputs are given in.
        has_depth: whether it gives depth.
    """

    name: str
    render: Callable[[BenchScene, dict[str, Tensor]], Pictures]
    dtype: torch.dtype = torch.float32
    has_depth: bool = True

    def forward(self, scene: BenchScene) -> Pictures:
        """Returns the pictures, without gradients."""
        with torch.no_grad():
            inputs = {k: v.to(self.dtype) for k, v in scene.inputs.items()}
            return self.render(scene, inputs)

    def gradients(self, scene: BenchScene) -> tuple[Pictures, dict[str, Tensor]]:
        """Returns the pictures and the gradients of the scene's scalar by input.

        The gradient on the pictures is given: forming it is no part of a renderer's work, and at 1024 px would be
        a third of what is timed.
        """
        leaves = scene.leaves(self.dtype)
        rgb, alpha, depth = self.render(scene, leaves)
        pictures = [p for p in (rgb, alpha, depth) if p is not None]
        cotangents = [w.to(p) for w, p in zip(scene.cotangents, pictures, strict=False)]
        torch.autograd.backward(pictures, cotangents)
        return (rgb, alpha, depth), {
            k: torch.zeros_like(v) if v.grad is None else v.grad for k, v in leaves.items()
        }


def backend(name: str, dtype: torch.dtype = torch.float32, limits: Limits = DEFAULT_LIMITS) -> Contestant:
    """Returns one of our backends as a contestant."""

    def render(scene: BenchScene, inputs: dict[str, Tensor]) -> Pictures:
        out = rasterize(**scene.arguments(inputs), backend=name, limits=limits)
        return out.rgb, out.alpha, out.depth

    title = name if dtype == torch.float32 else f"{name} float64"
    return Contestant(title, render, dtype)


def tiled(tile: int, dtype: torch.dtype = torch.float32) -> Contestant:
    """Returns the `torch` backend with tiles of `tile` pixels."""

    def render(scene: BenchScene, inputs: dict[str, Tensor]) -> Pictures:
        given = scene.arguments(inputs)
        crop = (0, 0, given["width"], given["height"])
        out = torch_backend.render(
            Request(intrinsics=read_intrinsics(given.pop("K")), crop=crop, **given), tile
        )
        return out.rgb, out.alpha, out.depth

    return Contestant("torch" if dtype == torch.float32 else "torch float64", render, dtype)


def available_backends(device: torch.device, wanted: Sequence[str] | None = None) -> list[str]:
    """Returns the names of the backends that run on a device, the specification first.

    Raises:
        ConfigError: one that was asked for by name cannot run.
    """
    names = [name for name in BACKENDS if name != "auto"] if wanted is None else list(wanted)
    able = []
    for name in names:
        try:
            able.append(resolve_backend(name, device, torch.float32))
        except ConfigError:
            if wanted is not None:
                raise
    return able


def peers() -> list[Contestant]:
    """Returns other packages that render Gaussians on a CPU and are installed."""
    found = []
    if importlib.util.find_spec("metal_gauss") is not None:
        found.append(Contestant("metal-gauss torch_ref", _metal_gauss, has_depth=False))
    return found


def _metal_gauss(scene: BenchScene, inputs: dict[str, Tensor]) -> Pictures:
    """Renders with the pure-torch reference of metal-gauss; on a CPU tiles of 16 px are its fastest."""
    module = importlib.import_module("metal_gauss.torch_ref")
    given = scene.arguments(inputs)
    rgb, alpha, _ = module.render(
        inputs["means"], inputs["quats"], inputs["scales"], inputs["opacities"], inputs["colors"],
        given["K"], given["viewmat"], given["width"], given["height"], sh_degree=scene.sh_degree, tile=16,
    )  # fmt: skip
    return rgb, alpha, None
