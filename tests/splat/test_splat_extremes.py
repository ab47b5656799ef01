"""Stiff and extreme input: bounded error, or a clear refusal; never NaN."""

from __future__ import annotations

import pytest
import torch
from splat_scenes import LAYERS, Scene, assert_same, make_scene, results
from torch import Tensor

from occfusion.errors import ConfigError, NumericsError
from occfusion.splat import Limits, rasterize
from oracles import splat as oracle

backends = pytest.mark.parametrize("backend", ["torch", "numba"])


def assert_finite(scene: Scene, backend: str) -> dict[str, Tensor]:
    layers, grads = results(scene, backend)
    for name, value in {**layers, **{f"gradient of {n}": g for n, g in grads.items()}}.items():
        assert bool(value.isfinite().all()), name
    return {**layers, **grads}


@backends
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_gaussians(backend: str, dtype: torch.dtype) -> None:
    if backend == "numba" and dtype == torch.float64:
        pytest.skip("float32 alone")
    scene = make_scene(n=0, dtype=dtype)
    found = assert_finite(scene, backend)
    assert bool((found["alpha"] == 0).all())
    assert torch.equal(found["rgb"], scene.tensors["background"].detach().expand(30, 40, 3))
    assert found["means"].shape == (0, 3)


@backends
@pytest.mark.parametrize("size", [(1, 1), (7, 513), (513, 7), (33, 17)])
def test_odd_picture_sizes(backend: str, size: tuple[int, int]) -> None:
    width, height = size
    scene = make_scene(n=5, width=width, height=height, size=0.3, degree=1)
    got = scene.to(torch.float32).render(backend)
    expected = oracle.render(**scene.arguments())
    assert got.rgb.shape == (height, width, 3)
    for name, layer in zip(LAYERS, expected, strict=True):
        assert_same(getattr(got, name), layer, 2e-5, name)


@backends
@pytest.mark.parametrize("z", [0.0, 1e-20, -1e-20, 1e-3, 0.01, -1.0, -1e30])
def test_nothing_culled_leaves_a_trace(backend: str, z: float) -> None:
    """At, before and behind the camera plane and at the near plane: no NaN anywhere, exactly zero gradient."""
    scene = make_scene(dtype=torch.float32, background=False)
    with torch.no_grad():
        viewmat = torch.eye(4)
        viewmat[2, 3] = 2.0
        scene.tensors["viewmat"].copy_(viewmat)
        scene.tensors["means"][0] = torch.tensor([0.3, 0.1, z - 2.0])
        if abs(z) < 1e-6:
            scene.tensors["viewmat"][2, 3] = 0.0
            scene.tensors["means"][:, 2] += 2.0
            scene.tensors["means"][0] = torch.tensor([0.3, 0.1, z])
    found = assert_finite(scene, backend)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert bool((found[name][0] == 0).all()), name
    assert float(found["means"].abs().max()) > 0


@backends
def test_just_beyond_the_near_plane(backend: str) -> None:
    scene = make_scene(n=1, size=0.002, degree=1)
    with torch.no_grad():
        scene.tensors["viewmat"].copy_(torch.eye(4))
        scene.tensors["means"].copy_(torch.tensor([[0.0005, -0.0003, 0.0101]]))
    got = scene.to(torch.float32).render(backend)
    assert_same(got.rgb, oracle.render(**scene.arguments())[0], 2e-5)
    assert_finite(scene.to(torch.float32), backend)


@backends
def test_camera_inside_a_gaussian(backend: str) -> None:
    scene = make_scene(n=3, size=3.0, degree=None)
    got = scene.to(torch.float32).render(backend)
    for name, layer in zip(LAYERS, oracle.render(**scene.arguments()), strict=True):
        assert_same(getattr(got, name), layer, 1e-4, name)
    assert_finite(scene.to(torch.float32), backend)


@backends
@pytest.mark.parametrize("norm", [0.0, 1e-40, 1e-20, 1e-10, 1e15, 1e20])
def test_quaternions_of_any_norm(backend: str, norm: float) -> None:
    scene = make_scene(n=5, dtype=torch.float32)
    unit = scene.render(backend)
    with torch.no_grad():
        direction = scene.tensors["quats"] / scene.tensors["quats"].norm(dim=-1, keepdim=True)
        scene.tensors["quats"].copy_(direction * norm)
    assert_finite(scene, backend)
    if norm >= 1e-10:
        assert_same(scene.render(backend).rgb, unit.rgb, 1e-5)


@backends
def test_zero_quaternion_is_the_identity_and_gets_no_gradient(backend: str) -> None:
    scene = make_scene(n=5, dtype=torch.float32)
    with torch.no_grad():
        scene.tensors["quats"].zero_()
    found = assert_finite(scene, backend)
    assert bool((found["quats"] == 0).all())
    with torch.no_grad():
        scene.tensors["quats"][:, 0] = 1
    assert_same(scene.render(backend).rgb, found["rgb"], 1e-6)


@pytest.mark.stiff
@backends
@pytest.mark.parametrize("log_scale", [-90.0, -20.0, 5.0, 20.0, 40.0])
def test_scales_from_nothing_to_the_universe(backend: str, log_scale: float) -> None:
    scene = make_scene(n=20, dtype=torch.float32)
    with torch.no_grad():
        scene.tensors["scales"][:10] = torch.tensor(log_scale).exp()
    found = assert_finite(scene, backend)
    if log_scale > 0:
        assert float(found["alpha"].detach().min()) > 0.5


@pytest.mark.stiff
@backends
@pytest.mark.parametrize("aspect", [1e2, 1e4, 1e6])
@pytest.mark.parametrize(("antialiased", "dilation"), [(False, 0.3), (True, 0.3), (False, 0.02)])
def test_needles(backend: str, aspect: float, antialiased: bool, dilation: float) -> None:
    """Needles 200 px long, 1e-4 of it thick: picture 5e-5, quaternion gradients 5e-4 (relative)."""
    size = 128
    scene = make_scene(n=12, width=size, height=size, degree=None, spread=0.05, background=False)
    with torch.no_grad():
        length = 200 * 2.0 / float(scene.K[0, 0])
        scene.tensors["scales"].copy_(torch.tensor([length, length / aspect, length / aspect]))
        scene.tensors["opacities"].fill_(0.8)
    scene.options["antialiased"] = False
    if antialiased:  # thin needles keep no mass at all; wider ones do
        scene.options["antialiased"] = True
        scene.tensors["scales"] = scene.tensors["scales"].detach().clamp_min(0.01).requires_grad_()
    expected = oracle.render(**scene.arguments(), dilation=dilation)
    got = scene.to(torch.float32)
    rendering = got.render(backend, limits=Limits(dilation=dilation))
    assert_same(rendering.rgb, expected[0], 5e-5, "rgb")
    weights = torch.randn(size, size, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    wanted = torch.autograd.grad(
        (expected[0] * weights).sum(), [scene.tensors["quats"], scene.tensors["means"]]
    )
    found = torch.autograd.grad(
        (rendering.rgb * weights.float()).sum(), [got.tensors["quats"], got.tensors["means"]]
    )
    assert_same(found[0], wanted[0], 5e-4, "quats")
    assert_same(found[1], wanted[1], 5e-4, "means")


@backends
def test_needle_covariances_are_finite(backend: str) -> None:
    """A float32 covariance of aspect 1e6 has lost its thin axis, and may not even be positive."""
    scene = make_scene(n=30, dtype=torch.float32)
    with torch.no_grad():
        scene.tensors["scales"].copy_(torch.tensor([1.0, 1e-6, 1e-6]))
        direction = torch.randn(30, 3, 1, generator=torch.Generator().manual_seed(0))
        flat = direction @ direction.transpose(1, 2)
    tensors = {n: t for n, t in scene.tensors.items() if n not in ("quats", "scales")}
    for antialiased in (False, True):
        flattened = Scene({**tensors, "covariances": flat.requires_grad_()}, scene.K, 40, 30, scene.options)
        flattened.options["antialiased"] = antialiased
        assert_finite(flattened, backend)


@backends
def test_opaque_layers_saturate_but_keep_gradients_finite(backend: str) -> None:
    scene = make_scene(n=400, size=0.5, spread=0.2, dtype=torch.float32)
    with torch.no_grad():
        scene.tensors["opacities"].fill_(1.0)
    found = assert_finite(scene, backend)
    assert float(found["alpha"].detach().max()) <= 1.0 + 1e-6
    # the inclusive stop: what is short of full cover is below the stop, not at the cap of one splat
    assert float(found["alpha"].detach().max()) >= 1 - 1e-4


@backends
def test_capped_alpha_has_no_gradient(backend: str) -> None:
    scene = make_scene(n=1, width=9, height=9, degree=None, size=5.0, dtype=torch.float32, background=False)
    with torch.no_grad():
        scene.tensors["means"].zero_()
        scene.tensors["scales"].fill_(50.0)
        scene.tensors["opacities"].fill_(1.0)
    alpha = scene.render(backend, crop=(4, 4, 1, 1)).alpha
    assert alpha.item() == pytest.approx(0.999, abs=1e-6)
    assert torch.autograd.grad(alpha.sum(), scene.tensors["opacities"])[0].item() == 0


@pytest.mark.stiff
@backends
def test_many_gaussians_in_one_pixel(backend: str) -> None:
    n = 20_000
    scene = make_scene(n=1, width=4, height=4, degree=None, size=0.001, dtype=torch.float32).take(
        torch.zeros(n, dtype=torch.long)
    )
    scene.tensors["opacities"] = torch.full((n,), 0.005, requires_grad=True)
    found = assert_finite(scene.to(torch.float32), backend)
    assert float(found["alpha"].detach().max()) <= 1


@backends
def test_depth_of_a_distant_and_a_near_splat(backend: str) -> None:
    for depth in (0.02, 1.0, 1e5):
        scene = make_scene(n=1, width=9, height=9, degree=None, dtype=torch.float32, background=False)
        with torch.no_grad():
            scene.tensors["viewmat"].copy_(torch.eye(4))
            scene.tensors["means"].copy_(torch.tensor([[0.0, 0.0, depth]]))
            scene.tensors["scales"].fill_(depth)
        rendering = scene.render(backend)
        assert float(rendering.depth[4, 4].detach()) == pytest.approx(depth, rel=1e-5)
        assert float(rendering.depth[rendering.alpha == 0].detach().abs().sum()) == 0


BAD = {
    "shape of quats": ({"quats": torch.zeros(60, 3)}, "quats has shape"),
    "number of opacities": ({"opacities": torch.zeros(59)}, "opacities has shape"),
    "dtype": ({"scales": torch.zeros(60, 3, dtype=torch.float64)}, "scales is torch.float64"),
    "half": ({"means": torch.zeros(60, 3).half()}, "means must be float32 or float64"),
    "both shapes": ({"covariances": torch.zeros(60, 3, 3)}, "either quats and scales, or covariances"),
    "no shape": ({"quats": None}, "either quats and scales, or covariances"),
    "degree": ({"sh_degree": 4}, "sh_degree must be 0..3"),
    "bands": ({"colors": torch.zeros(60, 4, 3)}, "sh_degree needs"),
    "colour kind": ({"sh_degree": None}, "colors has shape"),
    "viewmat": ({"viewmat": torch.eye(3)}, "viewmat has shape"),
    "zero focal": ({"K": torch.zeros(3, 3)}, "positive focal lengths"),
    "skew": ({"K": torch.tensor([[9.0, 1, 4], [0, 9, 4], [0, 0, 1]])}, "without skew"),
    "empty picture": ({"width": 0, "crop": (0, 0, 1, 1)}, "is empty"),
    "crop": ({"crop": (30, 0, 20, 10)}, "is not inside"),
    "near": ({"near": 0.0}, "near must be a positive depth"),
    "background": ({"background": torch.zeros(4)}, "background has shape"),
    "not a tensor": ({"means": [[0, 0, 0]]}, "means must be a tensor"),
    "backend": ({"backend": "cuda"}, "choose one of auto, torch, numba, gsplat"),
}


@pytest.mark.parametrize("case", BAD)
def test_wrong_input_is_refused(case: str) -> None:
    change, message = BAD[case]
    arguments = {**make_scene(dtype=torch.float32).arguments(), **change}
    with pytest.raises(ConfigError, match=message):
        rasterize(**arguments)


@backends
@pytest.mark.parametrize("name", ["means", "scales", "opacities", "colors", "viewmat"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_not_a_number_is_refused_by_name(backend: str, name: str, value: float) -> None:
    scene = make_scene(dtype=torch.float32)
    scene.tensors[name].data.view(-1)[3] = value
    with pytest.raises(NumericsError, match=f"{name} holds 1 values"):
        scene.render(backend)


@pytest.mark.stiff
@backends
@pytest.mark.parametrize("pixels", [1_000, 10_000])
def test_gradients_of_needles_longer_than_the_picture(backend: str, pixels: float) -> None:
    """A million times as long as thick: gradients 1e-4 (relative), quaternions' and thin scales' among them."""
    scene = make_scene(n=12, width=128, height=128, degree=None, spread=0.05, background=False)
    with torch.no_grad():
        length = pixels * 2.0 / float(scene.K[0, 0])
        scene.tensors["scales"].copy_(torch.tensor([length, length / 1e6, length / 1e6]))
        scene.tensors["opacities"].fill_(0.8)
    weights = torch.randn(128, 128, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    got, names = scene.to(torch.float32), ("quats", "means", "scales")
    wanted = torch.autograd.grad(
        (oracle.render(**scene.arguments())[0] * weights).sum(), [scene.tensors[name] for name in names]
    )
    found = torch.autograd.grad(
        (got.render(backend).rgb * weights.float()).sum(), [got.tensors[name] for name in names]
    )
    for name, value, expected in zip(names, found, wanted, strict=True):
        assert_same(value, expected, 1e-4, name)


def turned(change: str) -> Tensor:
    view = torch.eye(4)
    if change == "zero":
        return torch.zeros(4, 4)
    if change == "scaled":
        view[:3] *= 2.0
    elif change == "mirrored":
        view[0, 0] = -1.0
    else:
        view[3, 0] = 1.0
    return view


INDEFINITE = torch.tensor([[[1.0, 0.9, 0.9], [0.9, 1.0, -0.9], [0.9, -0.9, 1.0]]])
MEANINGLESS = {
    "background": ({"background": torch.tensor([0.0, float("nan"), 0.0])}, "background holds 1 values"),
    "faint": ({"opacities": torch.full((60,), -0.01)}, r"opacities: 60 are outside 0\.\.1"),
    "logits": ({"opacities": torch.full((60,), 3.0)}, r"opacities: 60 are outside 0\.\.1"),
    "far": ({"means": torch.full((60, 3), 1e38)}, "means: 60 are farther away"),
    "far to one side": ({"means": torch.tensor([[1e38, 0.0, 2.0]] * 60)}, "means: 60 are farther away"),
    "negative": ({"covariances": -torch.eye(3).expand(60, 3, 3)}, "covariances: 60 have a negative"),
    "indefinite": ({"covariances": INDEFINITE.expand(60, 3, 3)}, "covariances: 60 have a negative"),
    **{name: ({"viewmat": turned(name)}, "viewmat is not rigid") for name in ("zero", "scaled", "mirrored", "bent")},
}  # fmt: skip


@pytest.mark.parametrize("case", MEANINGLESS)
def test_values_without_a_meaning_are_refused(case: str) -> None:
    change, message = MEANINGLESS[case]
    arguments = make_scene(dtype=torch.float32).arguments()
    if "covariances" in change:
        arguments |= {"quats": None, "scales": None}
    with pytest.raises(NumericsError, match=message):
        rasterize(**{**arguments, **change}, backend="torch")


def test_a_crop_of_halves_is_refused() -> None:
    with pytest.raises(ConfigError, match="whole numbers of pixels"):
        make_scene(dtype=torch.float32).render("numba", crop=(0.5, 0, 10, 10))


@backends
def test_autocast_changes_nothing(backend: str) -> None:
    scene = make_scene(dtype=torch.float32)
    expected = scene.render(backend)
    with torch.autocast("cpu", torch.bfloat16):
        found = scene.render(backend)
    assert torch.equal(found.rgb, expected.rgb) and found.rgb.dtype == torch.float32
