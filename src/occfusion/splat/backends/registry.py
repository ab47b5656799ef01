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
    if name in ("numba", "gsplat"):
        raise ConfigError(f"rasterizer backend {name!r} is not available")
    return "torch"


def render_with(backend: str, request: Request) -> Layers:
    """Returns the blended layers of a resolved backend."""
    return torch_backend.render(request)
