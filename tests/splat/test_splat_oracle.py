"""The backends against the dense float64 oracle, in value and in every gradient."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
import torch
from splat_scenes import LAYERS, Scene, assert_all_same, gradients, make_scene, picture_weights, results

from occfusion.splat import Limits
from oracles import splat as oracle

BACKENDS = [("torch", torch.float64, 1e-9), ("torch", torch.float32, 1e-5), ("numba", torch.float32, 1e-5)]
CASES = {
    "harmonics": {},
    "plain colours": {"degree": None},
    "degree 0": {"degree": 0},
    "degree 1": {"degree": 1},
    "degree 2": {"degree": 2, "background": False},
    "covariances": {"covariances": True},
    "antialiased": {"antialiased": True, "size": 0.02},
    "antialiased covariances": {"antialiased": True, "covariances": True, "size": 0.02},
    "wide": {"spread": 3.0, "size": 0.4, "n": 80},  # many beyond the frustum margin and behind the camera
    # (no background: its gradient is the sum of a transmittance that float32 cannot tell from zero)
    "opaque": {"size": 0.4, "n": 120, "background": False},  # transmittance runs out
}


def oracle_results(scene: Scene, band: int = 64, **options: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """The oracle's layers and gradients; blended band of rows by band of rows to bound the memory."""
    arguments = scene.arguments()
    background = arguments.pop("background", None)
    flat = oracle.project(**arguments, **options)
    leaves = [f.detach().requires_grad_() for f in flat]
    sources = [*leaves, background] if background is not None else leaves
    weights, parts, totals = picture_weights(scene), [], [torch.zeros_like(leaf) for leaf in sources]
    for top in range(0, scene.height, band):
        rows = (top, min(scene.height, top + band))
        layers = oracle.blend(*leaves, scene.width, rows, background)
        loss = sum((a * weights[n][rows[0] : rows[1]]).sum() for n, a in zip(LAYERS, layers, strict=True))
        totals = [t + g for t, g in zip(totals, torch.autograd.grad(loss, sources), strict=True)]
        parts.append([layer.detach() for layer in layers])
    total = sum((f * t).sum() for f, t in zip(flat, totals, strict=False))
    grads = gradients(scene, {"total": total}, {"total": torch.ones(())})
    if background is not None:
        grads["background"] = totals[-1]
    pictures = [torch.cat(bands) for bands in zip(*parts, strict=True)]
    return dict(zip(LAYERS, pictures, strict=True)), grads


@pytest.mark.parametrize("case", CASES)
def test_backends_match_the_oracle(case: str) -> None:
    scene = make_scene(**CASES[case])
    expected = oracle_results(scene)
    for backend, dtype, tolerance in BACKENDS:
        got = results(scene.to(dtype), backend)
        assert got[0]["rgb"].dtype == dtype
        assert_all_same(got, expected, tolerance)


@pytest.mark.parametrize("size", [0.1, 0.003])
def test_backends_match_the_oracle_with_a_small_dilation(size: float) -> None:
    """What `E` draws with, for splats of several pixels and for those of a tenth of one, which miss most centres."""
    scene = make_scene(size=size, background=False)
    expected = oracle_results(scene, dilation=0.02)
    assert float(expected[0]["alpha"].max()) > 0.3
    for backend, dtype, tolerance in BACKENDS:
        got = results(scene.to(dtype), backend, limits=Limits(dilation=0.02))
        assert_all_same(got, expected, tolerance)


def test_oracle_sees_all_branches() -> None:
    """The scenes above exercise what they claim: a stop, a cap, culled ones and ones beyond the margin."""
    alpha = make_scene(**CASES["opaque"]).render("torch").alpha.detach()
    assert float(alpha.max()) > 0.9999
    wide = make_scene(**CASES["wide"])
    radii = wide.render("torch").radii
    assert 0 < int((radii[:, 0] == 0).sum()) < len(radii)


@pytest.mark.parametrize("backend", ["torch", "numba"])
@pytest.mark.parametrize(
    ("n", "size", "seed"),
    [(200, 40, 4), pytest.param(1200, 80, 3, marks=pytest.mark.slow)],
)
def test_many_gaussians_match_to_1e_5(n: int, size: int, seed: int, backend: str) -> None:
    # seeds for which no alpha is within 5e-6 of the cut, where float32 may decide otherwise
    scene, expected = _many(n, size, seed)
    assert_all_same(results(scene.to(torch.float32), backend), expected, 1e-5)


@cache
def _many(n: int, size: int, seed: int) -> tuple[Scene, Any]:
    scene = make_scene(n=n, width=size, height=size, size=0.03, spread=0.35, seed=seed)
    return scene, oracle_results(scene, 16)


@pytest.mark.parametrize("options", [{}, {"covariances": True}, {"antialiased": True}])
def test_gradcheck(options: dict[str, Any]) -> None:
    scene = make_scene(n=3, width=9, height=7, size=0.2, spread=0.2, degree=1, **options)
    names = list(scene.tensors)
    # opacities stay clear of the cap, and splats cover the picture: no threshold lies within eps
    scene.tensors["colors"] = scene.tensors["colors"].detach()[:, :4].clone().requires_grad_()
    scene.tensors["opacities"] = torch.full((3,), 0.7, dtype=torch.float64, requires_grad=True)

    def layers(*tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        given = {**scene.arguments(), **dict(zip(names, tensors, strict=True))}
        rendering = Scene({n: given[n] for n in names}, scene.K, 9, 7, scene.options).render("torch")
        return rendering.rgb, rendering.alpha

    assert torch.autograd.gradcheck(layers, tuple(scene.tensors.values()), eps=1e-7, atol=1e-4, rtol=1e-3)
