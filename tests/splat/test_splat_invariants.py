"""What must not change the picture, for each backend (metamorphic tests)."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from splat_scenes import LAYERS, assert_all_same, assert_same, gradients, make_scene, picture_weights, results

from occfusion.splat.backends import torch_backend
from occfusion.splat.request import Request, read_intrinsics

BACKENDS = [("torch", torch.float64, 1e-9), ("numba", torch.float32, 2e-5)]
backends = pytest.mark.parametrize(("backend", "dtype", "tolerance"), BACKENDS)


@backends
def test_order_of_gaussians(backend: str, dtype: torch.dtype, tolerance: float) -> None:
    scene = make_scene(dtype=dtype)
    order = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    shuffled = scene.take(order).to(dtype)
    layers, grads = results(shuffled, backend)
    inverse = order.argsort()
    grads = {n: g if n in ("viewmat", "background") else g[inverse] for n, g in grads.items()}
    assert_all_same((layers, grads), results(scene, backend), tolerance)


@backends
def test_rigid_motion_of_world_and_camera(backend: str, dtype: torch.dtype, tolerance: float) -> None:
    scene = make_scene(dtype=torch.float64, covariances=True, degree=None)
    moved = scene.to(torch.float64)
    R = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)).Q
    R = R * torch.linalg.det(R).sign()
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = R, torch.tensor([0.3, -1.0, 0.7])
    moved.tensors["means"] = scene.tensors["means"] @ R.T + motion[:3, 3]
    moved.tensors["covariances"] = R @ scene.tensors["covariances"] @ R.T
    moved.tensors["viewmat"] = scene.tensors["viewmat"] @ torch.linalg.inv(motion)
    a, b = scene.to(dtype).render(backend), moved.to(dtype).render(backend)
    for name in LAYERS:
        assert_same(getattr(b, name), getattr(a, name), tolerance, name)


@backends
def test_scale_of_the_world(backend: str, dtype: torch.dtype, tolerance: float) -> None:
    scene = make_scene(dtype=dtype)
    larger = scene.to(dtype)
    for name in ("means", "scales"):
        larger.tensors[name] = scene.tensors[name] * 4.0
    viewmat = scene.tensors["viewmat"].detach().clone()
    viewmat[:3, 3] *= 4.0
    larger.tensors["viewmat"] = viewmat
    a, b = scene.render(backend), larger.render(backend)
    assert_same(b.rgb, a.rgb, tolerance)
    assert_same(b.depth, 4 * a.depth, tolerance)


@backends
def test_splitting_an_opacity_in_two(backend: str, dtype: torch.dtype, tolerance: float) -> None:
    """Two splats at one place with o' = 1 - sqrt(1 - o) hide as much, at the centre, as one with o."""
    scene = make_scene(n=1, width=17, height=17, size=0.3, degree=None, dtype=dtype, background=False)
    scene.tensors["means"] = torch.zeros(1, 3, dtype=dtype)
    scene.tensors["opacities"] = torch.tensor([0.8], dtype=dtype)
    twice = scene.take(torch.tensor([0, 0]))
    twice.tensors["opacities"] = 1 - (1 - scene.tensors["opacities"][[0, 0]]).sqrt()
    K = scene.K.clone()
    viewmat = torch.eye(4, dtype=dtype)
    viewmat[2, 3] = 2.0
    K[0, 2], K[1, 2] = 8.5, 8.5  # the centre falls on a pixel centre
    for s in (scene, twice):
        s.K, s.tensors["viewmat"] = K, viewmat
    assert scene.render(backend).alpha[8, 8].item() == pytest.approx(
        twice.render(backend).alpha[8, 8].item(), rel=1e-6
    )
    assert scene.render(backend).alpha[8, 8].item() == pytest.approx(0.8, rel=1e-6)


@backends
def test_invisible_gaussians_change_nothing(backend: str, dtype: torch.dtype, tolerance: float) -> None:
    """Zero opacity, off the picture, behind, at the camera: not even in the gradients, which are exactly zero."""
    scene = make_scene(dtype=dtype)
    padded = scene.take(torch.cat([torch.arange(60), torch.arange(5)])).to(dtype)
    with torch.no_grad():
        camera = -scene.tensors["viewmat"][:3, :3].T @ scene.tensors["viewmat"][:3, 3]
        axis = scene.tensors["viewmat"][2, :3]
        padded.tensors["opacities"][60] = 0
        padded.tensors["means"][61] = camera + 2 * axis + 50 * scene.tensors["viewmat"][0, :3]
        padded.tensors["means"][62] = camera - axis
        padded.tensors["means"][63] = camera
        padded.tensors["opacities"][64] = 0.003
    layers, grads = results(padded, backend)
    for name, grad in grads.items():
        if name not in ("viewmat", "background"):
            assert bool((grad[60:] == 0).all()), name
    grads = {n: g if n in ("viewmat", "background") else g[:60] for n, g in grads.items()}
    expected = results(scene, backend)
    assert_all_same((layers, grads), expected, tolerance)
    assert torch.equal(layers["rgb"], expected[0]["rgb"])


@backends
def test_background_is_linear_in_what_is_not_covered(
    backend: str, dtype: torch.dtype, tolerance: float
) -> None:
    scene = make_scene(dtype=dtype, background=False)
    color = torch.tensor([0.3, 0.7, 0.1], dtype=dtype)
    black, tinted = scene.render(backend), scene.render(backend, background=color)
    assert_same(tinted.rgb, black.rgb + (1 - black.alpha)[..., None] * color, tolerance)
    assert torch.equal(tinted.alpha, black.alpha)
    assert torch.equal(tinted.depth, black.depth)


@backends
@pytest.mark.parametrize(
    "crop", [(0, 0, 40, 30), (7, 3, 1, 1), (5, 9, 20, 17), (33, 0, 7, 30), (0, 29, 40, 1)]
)
def test_crop_is_the_slice(backend: str, dtype: torch.dtype, tolerance: float, crop: tuple[int, ...]) -> None:
    scene = make_scene(dtype=dtype)
    x, y, w, h = crop
    full = scene.render(backend)
    weights = {n: v[y : y + h, x : x + w] for n, v in picture_weights(scene).items()}
    whole = {n: getattr(full, n)[y : y + h, x : x + w] for n in LAYERS}
    part = {n: getattr(scene.render(backend, crop=crop), n) for n in LAYERS}
    assert part["rgb"].shape == (h, w, 3)
    expected = gradients(scene, whole, weights)
    assert_all_same((part, gradients(scene, part, weights)), (whole, expected), tolerance)


@pytest.mark.parametrize("tile", [3, 16, 40])
def test_tile_size_changes_nothing(tile: int) -> None:
    scene = make_scene()
    arguments = scene.arguments()
    K = arguments.pop("K")
    request = Request(**arguments, intrinsics=read_intrinsics(K), crop=(0, 0, 40, 30))
    a, b = torch_backend.render(request), torch_backend.render(request, tile=tile)
    for name in LAYERS:
        assert_same(getattr(b, name), getattr(a, name), 1e-12, name)


@backends
def test_screen_offsets_move_the_picture(backend: str, dtype: torch.dtype, tolerance: float) -> None:
    scene = make_scene(dtype=dtype, background=False)
    shifted = scene.render(
        backend, screen_offsets=torch.tensor([[3.0, -2.0]], dtype=dtype).expand(60, 2).contiguous()
    )
    straight = scene.render(backend)
    assert_same(shifted.rgb[:-2, 3:], straight.rgb[2:, :-3], 10 * tolerance)


@backends
def test_equal_depths_keep_the_input_order(backend: str, dtype: torch.dtype, tolerance: float) -> None:
    n = 800  # few enough that the transmittance does not reach the stop
    scene = make_scene(n=1, width=9, height=9, degree=None, size=0.4, dtype=dtype, background=False).take(
        torch.zeros(n, dtype=torch.long)
    )
    scene.tensors["opacities"] = torch.full((n,), 0.01, dtype=dtype)
    ramp = torch.linspace(0, 1, n, dtype=dtype)
    scene.tensors["colors"] = ramp[:, None].expand(n, 3).contiguous()
    rendering = scene.render(backend, crop=(4, 4, 1, 1))
    alpha = rendering.alpha.detach()
    peak = 1 - (1 - float(alpha)) ** (1 / n)
    assert 0.003 < peak <= 0.01
    rgb = float(rendering.rgb[0, 0, 0])
    weights = peak * (1 - peak) ** torch.arange(n, dtype=torch.float64)
    assert rgb == pytest.approx(float((weights * ramp.double()).sum()), rel=1e-3)


def test_radii_are_the_exact_reach() -> None:
    scene = make_scene(n=1, width=80, height=60, degree=None, size=0.12)
    scene.tensors["means"] = torch.zeros(1, 3, dtype=torch.float64)
    rendering = scene.render("torch", background=None)
    columns = (rendering.alpha > 0).any(0).nonzero().flatten()
    rows = (rendering.alpha > 0).any(1).nonzero().flatten()
    rx, ry = rendering.radii[0].tolist()
    assert abs((columns[-1] - columns[0] + 1) / 2 - rx) <= 1
    assert abs((rows[-1] - rows[0] + 1) / 2 - ry) <= 1


def test_views_and_strided_inputs_are_accepted() -> None:
    scene = make_scene(dtype=torch.float32)
    wide = torch.zeros(60, 16, 6)
    wide[..., ::2] = scene.tensors["colors"].detach()
    strided = replace(scene, tensors={**scene.tensors, "colors": wide[..., ::2]})
    for backend in ("torch", "numba"):
        assert torch.equal(strided.render(backend).rgb, scene.render(backend).rgb)
