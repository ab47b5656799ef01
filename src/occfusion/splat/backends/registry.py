"""Which backend runs, and why."""

from __future__ import annotations

import importlib.util
import logging
from functools import cache

import torch

from occfusion.errors import ConfigError
from occfusion.splat.backends import torch_backend
from occfusion.splat.request import Request
from occfusion.types import Rendering

logger = logging.getLogger(__name__)

BACKENDS = ("auto", "torch", "numba", "gsplat")
DEVICES = {"numba": "cpu", "gsplat": "cuda"}
"""Where a backend runs; torch's runs anywhere."""


def resolve_backend(name: str, device: torch.device, dtype: torch.dtype = torch.float32) -> str:
    """Returns the backend that `name` stands for on a device: itself, or the best one for `auto`.

    Raises:
        ConfigError: the name is unknown, or the backend cannot run there.
    """
    if name not in BACKENDS:
        raise ConfigError(f"rasterizer backend {name!r} is unknown; choose one of {', '.join(BACKENDS)}")
    if name == "auto":
        return _best_backend(device.type, dtype)
    wanted = DEVICES.get(name)
    if wanted is not None and (device.type != wanted or dtype != torch.float32):
        raise ConfigError(
            f"rasterizer backend {name!r} takes float32 on {wanted}, got {dtype} on {device};"
            " use 'torch' or 'auto'"
        )
    if wanted is not None and importlib.util.find_spec(name) is None:
        extra = "occfusion[gpu]" if name == "gsplat" else "numba"
        raise ConfigError(f"rasterizer backend {name!r} is not installed; install {extra}, or use 'torch'")
    return name


def fitting_backend(name: str, device: torch.device) -> str:
    """Returns `name` where it runs on a device, else the best backend there.

    For pictures outside training, which are made where the avatar is: on the host, where it is read from a file.
    """
    return resolve_backend(name if DEVICES.get(name, device.type) == device.type else "auto", device)


@cache
def _best_backend(device: str, dtype: torch.dtype) -> str:
    """Returns the fastest backend that is exact on a kind of device; says so in the log, once."""
    name, reason = _choose(device, dtype)
    logger.info("rasteriser backend %s on %s, %s: %s", name, device, dtype, reason)
    return name


def _choose(device: str, dtype: torch.dtype) -> tuple[str, str]:
    if dtype != torch.float32:
        return "torch", "the faster backends take float32 only"
    if device == "cpu":
        if importlib.util.find_spec("numba") is None:
            return "torch", "numba is not installed"
        return "numba", "the fastest on a CPU"
    if device != "cuda":
        return "torch", "it runs on any device"
    if importlib.util.find_spec("gsplat") is None:
        return "torch", "gsplat is not installed (occfusion[gpu])"
    from occfusion.splat.backends import gsplat_backend

    problem = gsplat_backend.self_test(torch.device(device))
    if problem is not None:
        return "torch", f"gsplat is installed but did not pass its self-test: {problem}"
    return "gsplat", "its picture and gradients match the torch backend"


def render_with(backend: str, request: Request) -> Rendering:
    """Returns the layers of a resolved backend; only the backend that runs is imported."""
    if backend == "numba":
        from occfusion.splat.backends.numba import backend as numba_backend

        return numba_backend.render(request)
    if backend == "gsplat":
        from occfusion.splat.backends import gsplat_backend

        return gsplat_backend.render(request)
    return torch_backend.render(request)
