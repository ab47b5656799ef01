"""The backends against the dense float64 oracle, in value and in every gradient."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
import torch
from oracles import splat as oracle
from splat_scenes import LAYERS, Scene, assert_all_same, gradients, make_scene, picture_weights, results

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


def oracle_results(scene: Scene, bands: int = 1) -> tuple[dict[str, Any], dict[str, Any]]:
    """The oracle's layers and gradients, band of rows by band of rows to bound the memory."""
    weights, edges = picture_weights(scene), torch.linspace(0, scene.height, bands + 1).long().tolist()
    parts, total = [], None
    for top, end in zip(edges[:-1], edges[1:], strict=True):
        layers = dict(zip(LAYERS, oracle.render(**scene.arguments(), rows=(top, end)), strict=True))
        part = gradients(scene, layers, {n: w[top:end] for n, w in weights.items()})
        total = part if total is None else {n: total[n] + part[n] for n in part}
        parts.append({n: layer.detach() for n, layer in layers.items()})
    assert total is not None
    return {n: torch.cat([p[n] for p in parts]) for n in LAYERS}, total


@pytest.mark.parametrize("case", CASES)
def test_backends_match_the_oracle(case: str) -> None:
    scene = make_scene(**CASES[case])
    expected = oracle_results(scene)
    for backend, dtype, tolerance in BACKENDS:
        got = results(scene.to(dtype), backend)
        assert got[0]["rgb"].dtype == dtype
        assert_all_same(got, expected, tolerance)


def test_oracle_sees_all_branches() -> None:
    """The scenes above exercise what they claim: a stop, a cap, culled ones and ones beyond the margin."""
    alpha = make_scene(**CASES["opaque"]).render("torch").alpha
    assert float(alpha.max()) > 0.9999
    wide = make_scene(**CASES["wide"])
    radii = wide.render("torch").radii
    assert 0 < int((radii[:, 0] == 0).sum()) < len(radii)


@pytest.mark.parametrize("backend", ["torch", "numba"])
@pytest.mark.parametrize(
    ("n", "size", "bands"), [(200, 40, 1), pytest.param(2000, 128, 16, marks=pytest.mark.slow)]
)
def test_many_gaussians_match_to_1e_5(n: int, size: int, bands: int, backend: str) -> None:
    scene, expected = _many(n, size, bands)
    assert_all_same(results(scene.to(torch.float32), backend), expected, 1e-5)


@cache
def _many(n: int, size: int, bands: int) -> tuple[Scene, Any]:
    scene = make_scene(n=n, width=size, height=size, size=0.03, spread=0.35, seed=3)
    return scene, oracle_results(scene, bands)


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
