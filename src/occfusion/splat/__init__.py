"""Differentiable splatting of 3D Gaussians: one stateless function and its backends."""

from occfusion.splat.backends.registry import fitting_backend, resolve_backend
from occfusion.splat.limits import Limits
from occfusion.splat.rasterize import rasterize

__all__ = ["Limits", "fitting_backend", "rasterize", "resolve_backend"]
