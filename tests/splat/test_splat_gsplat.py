"""The adapter to gsplat, against a stand-in with gsplat's interface that blends densely on the CPU."""

from __future__ import annotations

import sys
import types

import pytest
import torch
from splat_scenes import assert_all_same, assert_same, make_scene, results
from torch import Tensor

from occfusion.errors import ConfigError
from occfusion.splat import resolve_backend
from occfusion.splat.backends import gsplat_backend, registry

CPU = torch.device("cpu")


def isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int
):  # type: ignore[no-untyped-def]
    """Keys (tile, depth bits) and splat numbers of all intersections, sorted, as gsplat 1.5 returns them."""
    assert radii.dtype == torch.int32 and means2d.shape[0] == 1 and radii.shape == means2d.shape
    found = []
    for i, ((x, y), (rx, ry), z) in enumerate(
        zip(means2d[0].tolist(), radii[0].tolist(), depths[0].tolist(), strict=True)
    ):
        x0, x1 = max(0, int((x - rx) // tile_size)), min(tile_width, int(-((-x - rx) // tile_size)))
        y0, y1 = max(0, int((y - ry) // tile_size)), min(tile_height, int(-((-y - ry) // tile_size)))
        found += [(ty * tile_width + tx, z, i) for ty in range(y0, y1) for tx in range(x0, x1)]
    found.sort()
    keys = torch.tensor([f[0] for f in found], dtype=torch.int64)
    return None, keys, torch.tensor([f[2] for f in found], dtype=torch.int32)


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    tiles = torch.arange(tile_width * tile_height)
    return torch.searchsorted(isect_ids, tiles).int().view(n_images, tile_height, tile_width)


def rasterize_to_pixels(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, image_width: int, image_height: int,
    tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Tile by tile over its list, the transmittance stop exclusive as in gsplat."""
    n = means2d.shape[1]
    assert conics.shape == (1, n, 3) and colors.shape == (1, n, 4) and opacities.shape == (1, n)
    starts = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    rows = []
    for ty in range(isect_offsets.shape[1]):
        row = []
        for tx in range(isect_offsets.shape[2]):
            tile = ty * isect_offsets.shape[2] + tx
            ids = flatten_ids[starts[tile] : starts[tile + 1]].tolist()
            step = torch.arange(tile_size) + 0.5
            ys, xs = torch.meshgrid(ty * tile_size + step, tx * tile_size + step, indexing="ij")
            T, out, running = (
                torch.ones_like(xs),
                torch.zeros(*xs.shape, 4),
                torch.ones_like(xs, dtype=torch.bool),
            )
            for i in ids:
                dx, dy = means2d[0, i, 0] - xs, means2d[0, i, 1] - ys
                a, b, c = conics[0, i]
                sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
                alpha = (opacities[0, i] * torch.exp(-sigma)).clamp(max=0.999)
                ok = running & (alpha >= 1 / 255)
                running = running & ~(ok & (T * (1 - alpha) <= 1e-4))
                alpha = torch.where(ok & running, alpha, 0.0)
                out = out + (T * alpha)[..., None] * colors[0, i]
                T = T * (1 - alpha)
            row.append(torch.cat([out, (1 - T)[..., None]], dim=-1))
        rows.append(torch.cat(row, dim=1))
    picture = torch.cat(rows)[None, :image_height, :image_width]
    return picture[..., :4], picture[..., 4:]


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    module = types.ModuleType("gsplat")
    for function in (isect_tiles, isect_offset_encode, rasterize_to_pixels):
        setattr(module, function.__name__, function)
    monkeypatch.setitem(sys.modules, "gsplat", module)
    # the stand-in runs on a CPU, where the real one is refused
    entry = sys.modules["occfusion.splat.rasterization"]
    monkeypatch.setattr(entry, "resolve_backend", lambda name, *_: name)
    return module


@pytest.mark.parametrize("options", [{}, {"covariances": True, "degree": None}, {"antialiased": True}])
def test_conventions_are_mapped(library: types.ModuleType, options: dict[str, object]) -> None:
    scene = make_scene(n=40, dtype=torch.float32, **options)
    scene.tensors["opacities"] = (scene.tensors["opacities"].detach() * 0.3 + 0.02).requires_grad_()
    assert_all_same(results(scene, "gsplat"), results(scene, "torch"), 2e-4)


def test_crop_and_empty_picture(library: types.ModuleType) -> None:
    scene = make_scene(n=20, dtype=torch.float32)
    crop = (7, 5, 21, 19)
    assert_same(scene.render("gsplat", crop=crop).depth, scene.render("torch", crop=crop).depth, 2e-4)
    empty = make_scene(n=0, dtype=torch.float32)
    assert torch.equal(empty.render("gsplat").rgb, empty.render("torch").rgb)


def test_self_test_accepts_what_is_right(library: types.ModuleType) -> None:
    assert gsplat_backend.self_test(CPU) is None


@pytest.mark.parametrize("fault", ["shifted", "wrong depth", "wrong gradient", "raises"])
def test_self_test_refuses_what_is_wrong(
    library: types.ModuleType, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(
        means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, *rest: object
    ) -> tuple[Tensor, Tensor]:
        if fault == "raises":
            raise RuntimeError("CUDA error: no kernel image is available")
        if fault == "shifted":
            means2d = means2d + 0.5  # pixel centres at whole numbers
        if fault == "wrong gradient":  # the off-diagonal of the conic gets half its gradient
            half = torch.stack(
                [conics[..., 0], conics[..., 1] / 2 + conics[..., 1].detach() / 2, conics[..., 2]], -1
            )
            conics = half
        picture, alpha = rasterize_to_pixels(means2d, conics, colors, opacities, *rest)  # type: ignore[arg-type]
        if fault == "wrong depth":
            picture = torch.cat([picture[..., :3], picture[..., 3:] / alpha.clamp_min(1e-6)], -1)
        return picture, alpha

    library.rasterize_to_pixels = wrong  # type: ignore[attr-defined]
    problem = gsplat_backend.self_test(CPU)
    assert problem is not None
    assert ("failed" if fault == "raises" else "is off by") in problem
    # and auto then says why it runs the torch backend
    monkeypatch.setattr(gsplat_backend, "self_test", lambda device: problem)
    monkeypatch.setattr(registry.importlib.util, "find_spec", lambda name: object())
    name, reason = registry._choose("cuda", torch.float32)
    assert name == "torch"
    assert problem in reason


def test_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ConfigError, match="cannot be imported"):
        gsplat_backend.load_library()
    with pytest.raises(ConfigError, match="takes float32 on cuda"):
        resolve_backend("gsplat", CPU, torch.float32)
    monkeypatch.setattr(registry.importlib.util, "find_spec", lambda name: None)
    assert registry._choose("cuda", torch.float32)[0] == "torch"
    assert registry._choose("cpu", torch.float32) == ("torch", "numba is not installed")


def test_fixed_cut_offs_are_refused(library: types.ModuleType) -> None:
    from occfusion.splat import Limits

    with pytest.raises(ConfigError, match="fixed cut-offs"):
        make_scene(dtype=torch.float32).render("gsplat", limits=Limits(stop=1e-3))
    with pytest.raises(ConfigError, match="takes float32"):
        make_scene().render("gsplat")


def test_log_says_which_and_why(caplog: pytest.LogCaptureFixture) -> None:
    registry._best_backend.cache_clear()
    with caplog.at_level("INFO"):
        resolve_backend("auto", CPU, torch.float64)
    assert "rasteriser backend torch on cpu, torch.float64" in caplog.text
