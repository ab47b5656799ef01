"""What the `numba` backend promises beyond the picture: agreement, determinism, leaving out, its cache."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_scenes import LAYERS, Scene, assert_all_same, gradients, make_scene, picture_weights, results

from occfusion.cpu.threads import usable_cores
from occfusion.errors import ConfigError
from occfusion.splat import Limits, resolve_backend
from occfusion.splat.backends.numba import ahead, backend, project
from occfusion.splat.backends.numba.bins import sort_by_depth
from occfusion.splat.backends.numba.layout import DEPTH, REACH, SPLAT_SIZE
from occfusion.splat.backends.numba.project import project_backward_part
from occfusion.splat.limits import DEFAULT_LIMITS

FLIP = 2 / 255
"""A pixel may differ by one dropped splat where rounding decides on which side of a cut-off it is."""


def picture_differs_only_at_flips(a: torch.Tensor, b: torch.Tensor, share: float = 0.005) -> bool:
    """Tight inside; at a cut-off a few pixels may cross, by no more than one faint splat."""
    difference = (a - b).abs().detach()
    scale = b.abs().max().detach() + 1e-3
    far = difference > 2e-5 * scale
    return (
        bool(difference.isfinite().all())
        and float(far.float().mean()) <= share
        and bool((difference <= FLIP * scale + 1e-3).all())
    )


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    n=st.integers(0, 80),
    width=st.integers(1, 70),
    height=st.integers(1, 40),
    degree=st.sampled_from([None, 0, 1, 2, 3]),
    seed=st.integers(0, 10_000),
    size=st.sampled_from([0.003, 0.03, 0.3, 2.0]),
    covariances=st.booleans(),
    background=st.booleans(),
    antialiased=st.booleans(),
    window=st.tuples(*[st.floats(0, 1)] * 4),
)
def test_agrees_with_torch(window: tuple[float, ...], width: int, height: int, **case: Any) -> None:
    scene = make_scene(width=width, height=height, dtype=torch.float32, **case)
    x, y = int(window[0] * (width - 1)), int(window[1] * (height - 1))
    crop = (x, y, max(1, int(window[2] * (width - x))), max(1, int(window[3] * (height - y))))
    reference, got = scene.render("torch", crop=crop), scene.render("numba", crop=crop)
    for name in ("rgb", "alpha"):
        # one crossing is a large share of a tiny window
        share = max(0.005, 1.5 / (crop[2] * crop[3]))
        assert picture_differs_only_at_flips(getattr(got, name), getattr(reference, name), share), name
    assert torch.allclose(got.radii, reference.radii, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("seed", [1, 2, 5])
@pytest.mark.parametrize("covariances", [False, True])
def test_gradients_agree_with_torch(seed: int, covariances: bool) -> None:
    scene = make_scene(n=150, width=70, height=50, seed=seed, covariances=covariances, dtype=torch.float32)
    # a splat that flips at a cut-off changes gradients by up to some 1e-3
    assert_all_same(results(scene, "numba"), results(scene, "torch"), 2e-3)


@pytest.mark.parametrize("antialiased", [False, True])
def test_bitwise_the_same_for_any_number_of_threads(antialiased: bool) -> None:
    scene = make_scene(n=700, width=150, height=90, dtype=torch.float32, antialiased=antialiased)
    before = torch.get_num_threads()
    try:
        found = []
        for threads in (1, 2, 3, 1):
            torch.set_num_threads(threads)
            found.append(results(scene, "numba"))
    finally:
        torch.set_num_threads(before)
    for layers, grads in found[1:]:
        assert all(torch.equal(layers[n], found[0][0][n]) for n in layers)
        assert all(torch.equal(grads[n], found[0][1][n]) for n in grads)


def test_backward_twice_gives_the_same() -> None:
    """The backward pass must not consume what the forward pass kept."""
    scene = make_scene(dtype=torch.float32)
    rgb = scene.render("numba").rgb
    first = torch.autograd.grad(rgb.sum(), scene.tensors["means"], retain_graph=True)[0]
    assert torch.equal(first, torch.autograd.grad(rgb.sum(), scene.tensors["means"])[0])


def test_inputs_are_not_written_to() -> None:
    scene = make_scene(width=1, height=1, dtype=torch.float32)
    before = {n: t.detach().clone() for n, t in scene.tensors.items()}
    results(scene, "numba")
    assert all(torch.equal(before[n], t) for n, t in scene.tensors.items())


@pytest.mark.parametrize(
    "wanted", ["means", "scales", "opacities", "colors", "viewmat", "background", "screen_offsets"]
)
@pytest.mark.parametrize("layer", LAYERS)
def test_any_subset_of_gradients(wanted: str, layer: str) -> None:
    """Leaving out gradients and layers nobody asked for does not change the others."""
    scene = make_scene(dtype=torch.float32)
    weights = picture_weights(scene)
    everything = gradients(scene, {layer: getattr(scene.render("numba"), layer)}, weights)[wanted]
    alone = Scene({n: t.detach() for n, t in scene.tensors.items()}, scene.K, 40, 30, scene.options)
    alone.tensors[wanted].requires_grad_()
    picture = getattr(alone.render("numba"), layer)
    if not picture.requires_grad:
        assert float(everything.abs().sum()) == 0
        return
    got = torch.autograd.grad(
        (picture * weights[layer].float()).sum(), alone.tensors[wanted], allow_unused=True
    )[0]
    assert torch.equal(
        everything if got is not None else torch.zeros(()), got if got is not None else torch.zeros(())
    )


def test_colors_alone_leave_the_geometry_out(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(dtype=torch.float32)
    alone = Scene({n: t.detach() for n, t in scene.tensors.items()}, scene.K, 40, 30, scene.options)
    alone.tensors["colors"].requires_grad_()

    def refuse(*_: Any) -> None:
        raise AssertionError("the gradient of shapes and places was computed")

    monkeypatch.setattr(backend, "blend_backward_part", refuse)
    (got,) = torch.autograd.grad(alone.render("numba").rgb.sum(), alone.tensors["colors"])
    monkeypatch.undo()
    expected = torch.autograd.grad(scene.render("numba").rgb.sum(), scene.tensors["colors"])[0]
    assert torch.equal(got, expected) and bool(got.any())


def test_background_alone_visits_no_gaussian(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(dtype=torch.float32)
    alone = Scene({n: t.detach() for n, t in scene.tensors.items()}, scene.K, 40, 30, scene.options)
    background = alone.tensors["background"].requires_grad_()
    rendering = alone.render("numba")
    monkeypatch.setattr(backend, "run_parts", lambda *_: pytest.fail("a kernel ran"))
    (got,) = torch.autograd.grad(rendering.rgb.sum(), background)
    assert torch.allclose(got, (1 - rendering.alpha).sum().expand(3))


def test_no_gradient_asked_for_none_recorded() -> None:
    scene = make_scene(dtype=torch.float32)
    with torch.no_grad():
        assert not scene.render("numba").rgb.requires_grad
    with torch.inference_mode():
        assert bool(scene.render("numba").rgb.isfinite().all())


def test_pixels_without_gradient_leave_splats_alone() -> None:
    """Gradient in one corner only: splats that do not reach it get exactly zero."""
    scene = make_scene(n=200, width=96, height=64, size=0.01, dtype=torch.float32)
    rendering = scene.render("numba")
    grad = torch.autograd.grad(rendering.rgb[:16, :32].sum(), scene.tensors["colors"], retain_graph=True)[0]
    reference = scene.render("torch").rgb[:16, :32].sum()
    expected = torch.autograd.grad(reference, scene.tensors["colors"])[0]
    touched = expected.flatten(1).abs().sum(1) > 0
    assert 0 < int(touched.sum()) < 200
    assert bool((grad[~touched] == 0).all())
    assert torch.allclose(grad, expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))


def test_depth_sort_is_stable_and_complete() -> None:
    generator = np.random.default_rng(0)
    splats = np.zeros((5000, SPLAT_SIZE), np.float32)
    splats[:, DEPTH] = np.exp(generator.normal(size=5000) * 5).astype(np.float32).round(2) + 0.01
    splats[:, REACH] = generator.random(5000) < 0.9
    visible = np.flatnonzero(splats[:, REACH])
    expected = visible[np.argsort(splats[visible, DEPTH], kind="stable")]
    means = np.zeros((5000, 3), np.float32)
    means[:, 2] = splats[:, DEPTH]
    assert np.array_equal(sort_by_depth(splats, means, looking_along_z()), expected)


def looking_along_z() -> np.ndarray:
    camera = np.zeros(23)
    camera[[0, 4, 8]] = 1.0
    return camera


def test_depths_that_rounding_makes_equal_are_told_apart() -> None:
    generator = np.random.default_rng(0)
    means = np.zeros((3000, 3), np.float32)
    means[:, 0] = generator.normal(size=3000)
    means[:, 2] = 3.0
    camera = looking_along_z()
    camera[6] = 1e-9  # a camera turned by so little that single precision does not see it
    splats = np.zeros((3000, SPLAT_SIZE), np.float32)
    splats[:, DEPTH] = means[:, 2]
    splats[:, REACH] = 1.0
    exact = 1e-9 * means[:, 0].astype(np.float64) + 3.0
    assert np.array_equal(sort_by_depth(splats, means, camera), np.argsort(exact, kind="stable"))


def test_it_is_what_auto_means_on_a_cpu() -> None:
    cpu = torch.device("cpu")
    assert resolve_backend("auto", cpu, torch.float32) == "numba"
    assert resolve_backend("auto", cpu, torch.float64) == "torch"
    scene = make_scene(dtype=torch.float32)
    assert torch.equal(scene.render("auto").rgb, scene.render("numba").rgb)


def test_float64_is_refused() -> None:
    with pytest.raises(ConfigError, match="takes float32"):
        make_scene().render("numba")


def test_other_limits() -> None:
    scene = make_scene(dtype=torch.float32)
    limits = Limits(alpha_max=0.9, alpha_min=0.02, stop=1e-2, dilation=0.5)
    assert_all_same(results(scene, "numba", limits=limits), results(scene, "torch", limits=limits), 1e-4)
    with pytest.raises(ConfigError, match="alpha_min >= 1/256"):
        scene.render("numba", limits=Limits(alpha_min=1e-3))
    assert DEFAULT_LIMITS.alpha_min >= backend.LEAST_ALPHA_MIN


def test_what_is_compiled_ahead_is_what_a_gradient_calls() -> None:
    for covariances in (False, True):
        make_scene(n=5, dtype=torch.float32, covariances=covariances).render("numba").rgb.sum().backward()
        known = list(project_backward_part.signatures)
        project.compile_last(covariances)
        assert list(project_backward_part.signatures) == known
    assert len(known) == 2


COMPILED = """
from numba.core import event
from occfusion.splat.backends.numba.project import compile_last

class Names(event.Listener):
    def on_start(self, begun):
        print(begun.data["dispatcher"].py_func.__name__)
    def on_end(self, ended):
        pass

event.register("numba:compile", Names())
compile_last({of_covariances})
"""


@pytest.mark.slow
@pytest.mark.parametrize("of_covariances", [False, True])
def test_what_no_shape_asks_for_is_not_compiled(tmp_path: Path, of_covariances: bool) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    told = subprocess.run(
        [sys.executable, "-c", COMPILED.format(of_covariances=of_covariances)], env=environment,
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    of_each = {"plane_from_root", "root_gradient"}, {"plane_from_covariance", "covariance_gradient"}
    compiled = set(told.stdout.split())
    assert "project_backward_part" in compiled
    assert of_each[of_covariances] <= compiled and not of_each[not of_covariances] & compiled


def test_what_compiles_it_loads_no_torch() -> None:
    told = subprocess.run(
        [sys.executable, "-c", f"{ahead.PROGRAM.format(of_covariances=True)}import sys\nprint('torch' in sys.modules)"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert told.stdout.strip() == "False"


def test_whether_a_kernel_is_cached_is_seen(tmp_path: Path) -> None:
    source, index = tmp_path / "numba_module.py", tmp_path / "numba_module.kernel-7.py311.nbi"
    source.write_text("")
    code = SimpleNamespace(co_filename=str(source))
    kernel = SimpleNamespace(
        py_func=SimpleNamespace(__code__=code, __qualname__="kernel"),
        stats=SimpleNamespace(cache_path=str(tmp_path)),
    )
    assert not ahead.is_cached(kernel)
    index.write_text("")
    assert ahead.is_cached(kernel)
    os.utime(index, (1, 1))  # older than the source
    assert not ahead.is_cached(kernel)
    kernel.stats.cache_path = None  # nowhere to leave anything
    assert ahead.is_cached(kernel)


AHEAD = """
import sys
sys.path.insert(0, {tests!r})
import torch
from splat_scenes import make_scene
from occfusion.splat.backends.numba import ahead
started, start = [], ahead.start
ahead.start = lambda program: (start(program), started.extend(ahead._helpers))
{before}
make_scene(n=5, dtype=torch.float32).render("numba").rgb.sum().backward()
from occfusion.splat.backends.numba import blend
from occfusion.splat.backends.numba.project import project_backward_part as last
counts = [(sum(k.stats.cache_hits.values()), sum(k.stats.cache_misses.values())) for k in (blend.blend_part, last)]
print(len(started), *counts)
"""


@pytest.mark.slow
def test_a_second_process_compiles_ahead(tmp_path: Path) -> None:
    """Cold: compiled into `NUMBA_CACHE_DIR`, the last kernel by the second process; then loaded from there.

    Where the second process fails, the last kernel is compiled here.
    """
    if usable_cores() < 2:
        pytest.skip("needs two cores")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}

    def said(before: str = "") -> str:
        program = AHEAD.format(tests=str(Path(__file__).parent), before=before)
        done = subprocess.run(
            [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    assert said() == "1 (0, 1) (1, 0)"
    assert said() == "0 (1, 0) (1, 0)"
    for path in tmp_path.rglob("*project_backward_part*"):
        path.unlink()
    assert said("ahead.PROGRAM = 'raise SystemExit(3)'") == "1 (1, 0) (0, 1)"
