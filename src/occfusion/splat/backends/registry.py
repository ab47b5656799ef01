"""Which backend runs."""

from __future__ import annotations

import torch

from occfusion.errors import ConfigError
from occfusion.splat.backends import torch_backend
from occfusion.splat.backends.layers import Layers
from occfusion.splat.request import Request

BACKENDS = ("auto", "torch", "numba", "gsplat")


def resolve_backend(name: str, device: torch.device, dtype: torch.dtype) -> str:
    """Returns the backend that `name` stands for on a device: itself, or the best one for `auto`.

    Raises:
        ConfigError: the name is unknown, or the backend cannot run there.
    """
    if name not in BACKENDS:
        raise ConfigError(f"rasterizer backend {name!r} is unknown; choose one of {', '.join(BACKENDS)}")
    if name == "gsplat":
        raise ConfigError(f"rasterizer backend {name!r} is not available")
    if name == "auto":
        return "numba" if device.type == "cpu" and dtype == torch.float32 else "torch"
    return name


def render_with(backend: str, request: Request) -> Layers:
    """Returns the blended layers of a resolved backend."""
    if backend == "numba":
        from occfusion.splat.backends import numba_backend

        return numba_backend.render(request)
    return torch_backend.render(request)
