"""The `gsplat` backend: blending by the CUDA kernels of gsplat (nerfstudio, Apache-2.0), an extra.

Only tile intersection and blending are gsplat's; projection, harmonics and culling stay those of
`splat.projection`, on the GPU, so that precomputed covariances, off-centre principal points, crops,
screen offsets and needles mean exactly the same as in the other backends.

What remains different: gsplat leaves out the splat at which transmittance falls to 1e-4, where ours
includes it, so alpha of a saturated pixel may be short by up to 1e-4 / (1 - alpha of that splat); and
its exponential is the approximate one of the GPU.
"""

from __future__ import annotations

import importlib
from types import ModuleType

import torch
from torch import Tensor

from occfusion.errors import ConfigError
from occfusion.splat.backends import torch_backend
from occfusion.splat.limits import DEFAULT_LIMITS
from occfusion.splat.projection import project
from occfusion.splat.request import Intrinsics, Request
from occfusion.types import Rendering

TILE = 16
"""Pixels; the only tile size that gsplat tests."""

IMAGE_TOLERANCE = 1e-3
GRADIENT_TOLERANCE = 1e-2
"""Relative, per input. A wrong convention errs by tens of per cent; float32 and the approximate
exponential by less than a tenth of this."""


def load_library() -> ModuleType:
    """Returns the gsplat module.

    Raises:
        ConfigError: it is not installed or cannot be imported.
    """
    try:
        return importlib.import_module("gsplat")
    except (ImportError, OSError) as error:
        raise ConfigError(
            f"rasterizer backend 'gsplat' cannot be imported ({error}); install occfusion[gpu] or use 'torch'"
        ) from error


def render(request: Request) -> Rendering:
    """Returns the crop of the picture, blended by gsplat.

    Raises:
        ConfigError: gsplat is missing, the input is not float32, or cut-offs differ from gsplat's.
    """
    gsplat = load_library()
    limits = request.limits
    ours = (limits.alpha_max, limits.alpha_min, limits.stop)
    if ours != (DEFAULT_LIMITS.alpha_max, DEFAULT_LIMITS.alpha_min, DEFAULT_LIMITS.stop):
        raise ConfigError(f"rasterizer backend 'gsplat' has fixed cut-offs, got {limits}")
    if request.means.dtype != torch.float32:
        raise ConfigError(f"rasterizer backend 'gsplat' takes float32, got {request.means.dtype}")
    splats = project(request)
    if len(splats.index) == 0:
        return torch_backend.render(request)  # nothing to blend, and gsplat does not take empty lists
    x, y, width, height = request.crop
    colors = torch_backend.visible_colors(request, splats.index)
    features = torch.cat([colors, splats.depths[:, None]], dim=1)
    centres = (splats.means2d - splats.means2d.new_tensor([x, y])).to(splats.factors.dtype)
    l1, m, l2 = splats.factors.unbind(-1)
    conics = torch.stack([l1 * l1, l1 * m, m * m + l2 * l2], dim=-1)
    extents = splats.extents.clamp_max(2.0**30).ceil().int()
    across, down = -(-width // TILE), -(-height // TILE)
    _, keys, flat = gsplat.isect_tiles(centres[None], extents[None], splats.depths[None], TILE, across, down)
    starts = gsplat.isect_offset_encode(keys, 1, across, down)
    picture, alpha = gsplat.rasterize_to_pixels(
        centres[None], conics[None], features[None], splats.opacities[None], width, height, TILE,
        starts.reshape(1, down, across), flat,
    )  # fmt: skip
    return torch_backend.finish(request, splats, picture[0, ..., :3], alpha[0, ..., 0], picture[0, ..., 3])


def self_test(device: torch.device) -> str | None:
    """Returns what differs between gsplat and the torch backend on `device`, or None when they match."""
    try:
        ours, theirs = _picture_and_gradients("torch", device), _picture_and_gradients("gsplat", device)
    except (ConfigError, RuntimeError, ImportError, AttributeError, TypeError, AssertionError) as error:
        return f"it failed: {error}"
    for name, reference in ours.items():
        value = theirs[name]
        if not bool(value.isfinite().all()):
            return f"its {name} is not finite"
        is_picture = name in ("rgb", "alpha", "depth")
        tolerance = IMAGE_TOLERANCE if is_picture else GRADIENT_TOLERANCE
        difference = float((value - reference).norm() / reference.norm())
        if difference > tolerance:
            return f"its {name} is off by {difference:.1e} (relative, allowed {tolerance:.0e})"
    return None


def _picture_and_gradients(backend: str, device: torch.device) -> dict[str, Tensor]:
    """Returns picture and gradients of a small scene that no cut-off of either backend touches.

    It has anisotropic covariances, an off-centre principal point, a crop, harmonics and depth.
    """
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    root = 0.06 * random(40, 3, 3)
    inputs = {
        "means": 0.3 * random(40, 3),
        "covariances": root @ root.transpose(1, 2),
        "opacities": 0.1 + 0.3 * random(40).sigmoid(),
        "colors": 0.2 * random(40, 4, 3),
        "screen_offsets": torch.zeros(40, 2),
        "viewmat": torch.tensor([[1.0, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]),
    }
    inputs = {name: tensor.to(device).requires_grad_() for name, tensor in inputs.items()}
    request = Request(
        quats=None, scales=None, intrinsics=Intrinsics(60.0, 62.0, 29.0, 25.0), width=64, height=48,
        crop=(5, 3, 50, 40), sh_degree=1, **inputs,  # type: ignore[arg-type]
    )  # fmt: skip
    layers = (render if backend == "gsplat" else torch_backend.render)(request)
    pictures = {"rgb": layers.rgb, "alpha": layers.alpha, "depth": layers.depth}
    weights = [random(*picture.shape).to(device) for picture in pictures.values()]
    gradients = torch.autograd.grad(list(pictures.values()), list(inputs.values()), weights)
    named = {f"gradient of {name}": grad for name, grad in zip(inputs, gradients, strict=True)}
    return {name: tensor.detach() for name, tensor in {**pictures, **named}.items()}
