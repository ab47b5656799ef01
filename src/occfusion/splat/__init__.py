"""Differentiable splatting of 3D Gaussians: one stateless function and its backends.

Loaded when asked for: a process that compiles kernels needs no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from occfusion.splat.backends.registry import fitting_backend, resolve_backend
    from occfusion.splat.limits import Limits
    from occfusion.splat.rasterization import rasterize

__all__ = ["Limits", "fitting_backend", "rasterize", "resolve_backend"]

_HOMES = {
    "Limits": "limits",
    "fitting_backend": "backends.registry",
    "rasterize": "rasterization",
    "resolve_backend": "backends.registry",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = found
    return found
